"""MuJoCo scenes, robots, cameras, and the benchmark suites."""

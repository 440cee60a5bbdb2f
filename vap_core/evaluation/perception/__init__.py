"""How well perception does on the benchmarks: what it saw, followed and cost, measured against the simulator and told as tables and curves."""

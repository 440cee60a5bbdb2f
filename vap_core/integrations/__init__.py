"""The benchmarks in other people's clothes."""

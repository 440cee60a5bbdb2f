"""How well perception does on the benchmarks, measured against the simulator.

What it found, tracked and cost, as tables and curves.
"""

"""From methods and studies to tables: engine, store, metrics, statistics, diagnosis, reports."""

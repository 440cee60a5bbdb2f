"""From methods and studies to tables: engine, store, metrics, statistics, diagnosis, reports."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

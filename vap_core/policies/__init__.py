"""Everything that maps images, text and proprioception to chunks of actions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

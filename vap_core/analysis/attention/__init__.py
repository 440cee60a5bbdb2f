"""Where a policy looks: measures of attention maps, the paper's patterns, figures; names load when
they are first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Visual Attentive Prompting: steer a frozen policy to the user's own object, and see why it worked
or failed.

The public names stand in `__init__.pyi` and load when they are first used: importing this package
loads no torch, mujoco or rerun. Start reading at attend.py.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"

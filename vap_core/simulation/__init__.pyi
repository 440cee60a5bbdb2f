from . import robots as robots
from .assets.objects import CLUTTER as CLUTTER
from .assets.objects import personal_instance as personal_instance
from .occluder import Occlusion as Occlusion
from .studio import Stage as Stage
from .suites import SUITES as SUITES
from .suites import VARIANTS as VARIANTS
from .suites import lists as lists

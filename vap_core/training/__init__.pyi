from .films.captions import describe as describe
from .films.dataset import about as about
from .films.dataset import read as read
from .films.demonstrations import after_a_miss as after_a_miss
from .policy.commands import Known as Known
from .policy.commands import command as command
from .policy.probe import probe as probe
from .recipe import RECIPES as RECIPES

"""Every family of objects. The order is part of what seeds mean: new families go to the end."""

from vap_core.sim.catalogue import classics, receptacles
from vap_core.sim.catalogue.family import Family as Family

FAMILIES: tuple[Family, ...] = (*classics.FAMILIES, *receptacles.FAMILIES)

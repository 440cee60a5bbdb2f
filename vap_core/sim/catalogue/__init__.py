"""Every family of objects. The order is part of what seeds mean: new families go to the end."""

from vap_core.sim.catalogue import classics, creatures, cups, decor, receptacles, wear
from vap_core.sim.catalogue.family import Family as Family

FAMILIES: tuple[Family, ...] = (*classics.FAMILIES, *creatures.FAMILIES, *wear.FAMILIES, *decor.FAMILIES, *receptacles.FAMILIES, *cups.FAMILIES)

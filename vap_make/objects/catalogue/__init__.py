"""Every family of objects. The order is part of what seeds mean: new families go to the end."""

from vap_make.objects.catalogue import (
    bags,
    cups,
    figurines,
    footwear,
    gadgets,
    ornaments,
    plants,
    receptacles,
    soft_toys,
    vessels,
)
from vap_make.objects.catalogue.family import Family as Family

FAMILIES: tuple[Family, ...] = (
    cups.CUP,
    vessels.BOTTLE,
    vessels.PEN_HOLDER,
    cups.STRAW_CUP,
    figurines.OWL,
    vessels.VASE,
    gadgets.CAMERA,
    gadgets.SHAVER,
    gadgets.COKE_CAN,
    figurines.CAT,
    soft_toys.PLUSHIE,
    soft_toys.STUFFED_TOY,
    bags.LEATHER_BAG,
    footwear.SHOE,
    footwear.SLIPPER,
    bags.POUCH,
    ornaments.HOUSE,
    ornaments.BUS,
    plants.PLANT,
    plants.SCRUBBER,
    ornaments.PAINTING,
    receptacles.PLATE,
    receptacles.BASKET,
    receptacles.PLASTIC_BOWL,
    cups.PAPER_CUP,
)

"""Names of objects in words: phrases that no detector is trained with, and ambiguous ones."""

UNSEEN: dict[str, tuple[str, ...]] = {
    "cup": ("teacup", "coffee cup", "drinking vessel", "beaker"),
    "bottle": ("thermos", "hydration bottle", "drinking bottle"),
    "pen holder": ("pencil case stand", "stationery holder", "pen stand"),
    "straw cup": ("drink with a straw", "travel tumbler", "bubble tea cup"),
    "owl figurine": ("owl ornament", "wooden owl", "owl toy"),
    "vase": ("urn", "flower pot vase", "glass vase"),
    "camera": ("photographic camera", "mirrorless camera", "point and shoot"),
    "shaver": ("trimmer", "shaving machine", "rechargeable razor"),
    "coke can": ("cola", "beverage can", "aluminium can"),
    "plushie": ("fluffy toy", "plush hedgehog", "plush figure"),
    "stuffed toy": ("stuffed doll", "fabric toy", "cuddly doll"),
    "leather bag": ("briefcase", "satchel", "leather purse"),
    "pouch": ("coin purse", "zip pouch", "toiletry pouch"),
    "shoe": ("trainers", "tennis shoe", "footwear"),
    "slipper": ("house slipper", "bedroom slipper", "indoor shoe"),
    "cat figurine": ("cat ornament", "cat sculpture", "kitten figurine"),
    "miniature house": ("dollhouse", "tiny house", "house model"),
    "plant": ("succulent", "pot plant", "green plant"),
    "scrubber": ("cleaning brush", "dish scrubber", "scouring brush"),
    "plastic bowl": ("salad bowl", "serving bowl"),
}
"""Phrases of each category that are never trained with."""

AMBIGUOUS: dict[str, tuple[str, ...]] = {
    "cup": ("straw cup", "pen holder"),
    "shoe": ("slipper",),
    "plushie": ("stuffed toy",),
    "stuffed toy": ("plushie",),
    "leather bag": ("pouch",),
    "vase": ("plant",),
    "pouch": ("leather bag",),
    "slipper": ("shoe",),
}
"""For a phrase of the first category, boxes of these others count neither as hits nor as errors."""

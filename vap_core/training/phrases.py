"""What people call things: phrases the detector is trained with, phrases kept back to test it, and phrases that name nothing here."""

SYNONYMS: dict[str, tuple[str, ...]] = {
    "cup": ("cup", "mug", "coffee mug", "tea cup", "ceramic mug", "cup with a handle", "drinking cup"),
    "bottle": ("bottle", "water bottle", "drink bottle", "plastic bottle", "sports bottle", "flask"),
    "pen holder": ("pen holder", "pencil holder", "pen cup", "pencil cup", "pen pot", "desk organizer for pens"),
    "straw cup": ("straw cup", "cup with a straw", "tumbler with straw", "tumbler", "iced coffee cup", "sippy cup"),
    "owl figurine": ("owl figurine", "owl statue", "owl", "owl sculpture", "ceramic owl", "bird figurine"),
    "vase": ("vase", "flower vase", "ceramic vase", "porcelain vase", "decorative vase"),
    "camera": ("camera", "photo camera", "digital camera", "film camera", "compact camera", "dslr camera"),
    "shaver": ("shaver", "electric shaver", "razor", "electric razor", "beard trimmer", "hair clipper"),
    "coke can": ("coke can", "soda can", "can of cola", "tin can", "drink can", "can"),
    "plushie": ("plushie", "plush toy", "soft toy", "teddy"),
    "stuffed toy": ("stuffed toy", "stuffed animal", "cuddly toy"),
    "leather bag": ("leather bag", "handbag", "purse"),
    "pouch": ("pouch", "small bag", "drawstring pouch"),
    "shoe": ("shoe", "sneaker", "running shoe"),
    "slipper": ("slipper", "house shoe", "slide sandal"),
    "cat figurine": ("cat figurine", "cat statue", "ceramic cat"),
    "miniature house": ("miniature house", "toy house", "model house"),
    "plant": ("plant", "potted plant", "houseplant"),
    "scrubber": ("scrubber", "scrub brush", "dish brush"),
    "plastic bowl": ("plastic bowl", "bowl", "mixing bowl"),
    "plate": ("plate", "dinner plate", "dish"),
    "basket": ("basket", "wicker basket", "bread basket"),
    "painting": ("painting", "framed picture", "picture frame"),
    "toy bus": ("toy bus", "bus", "school bus"),
}
"""Training phrases of each category, its own name first; a category without an entry is trained by its name alone."""

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
}
"""Synonyms never trained with."""

NEGATIVES: tuple[str, ...] = (
    "laptop", "keyboard", "book", "banana", "apple", "scissors", "spoon", "fork", "phone", "dog", "car", "table", "robot arm", "gripper",
    "person", "chair", "lamp", "window", "hat", "pillow", "clock", "ball", "cardboard box", "remote control", "toothbrush", "shadow", "wall",
    "umbrella", "elephant", "screwdriver", "notebook", "candle", "glasses", "key", "wallet", "headphones", "bread", "orange", "towel",
)  # fmt: skip
"""Phrases that name nothing in a training scene: they must find nothing."""

UNSEEN_NEGATIVES: tuple[str, ...] = ("bicycle", "pizza", "guitar", "hammer", "sock", "backpack", "hair dryer", "stapler", "calculator", "garden hose")

AMBIGUOUS: dict[str, tuple[str, ...]] = {
    "cup": ("straw cup", "pen holder"),
    "shoe": ("slipper",),
    "plushie": ("stuffed toy",),
    "stuffed toy": ("plushie",),
    "leather bag": ("pouch",),
    "vase": ("plant",),
}
"""`AMBIGUOUS[asked]`: kinds that one might also call so; finding them is neither rewarded nor punished."""


def phrases(category: str) -> tuple[str, ...]:
    return SYNONYMS.get(category, (category,))

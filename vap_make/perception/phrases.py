"""Phrases that the detector is trained with, and phrases that name nothing in the scenes."""

SYNONYMS: dict[str, tuple[str, ...]] = {
    "cup": (
        "cup",
        "mug",
        "coffee mug",
        "tea cup",
        "ceramic mug",
        "cup with a handle",
        "drinking cup",
    ),
    "bottle": (
        "bottle",
        "water bottle",
        "drink bottle",
        "plastic bottle",
        "sports bottle",
        "flask",
    ),
    "pen holder": (
        "pen holder",
        "pencil holder",
        "pen cup",
        "pencil cup",
        "pen pot",
        "desk organizer for pens",
    ),
    "straw cup": (
        "straw cup",
        "cup with a straw",
        "tumbler with straw",
        "tumbler",
        "iced coffee cup",
        "sippy cup",
    ),
    "owl figurine": (
        "owl figurine",
        "owl statue",
        "owl",
        "owl sculpture",
        "ceramic owl",
        "bird figurine",
    ),
    "vase": ("vase", "flower vase", "ceramic vase", "porcelain vase", "decorative vase"),
    "camera": (
        "camera",
        "photo camera",
        "digital camera",
        "film camera",
        "compact camera",
        "dslr camera",
    ),
    "shaver": (
        "shaver",
        "electric shaver",
        "razor",
        "electric razor",
        "beard trimmer",
        "hair clipper",
    ),
    "coke can": ("coke can", "soda can", "can of cola", "tin can", "drink can", "can"),
    "plushie": ("plushie", "plush toy", "soft toy", "teddy", "plush animal"),
    "stuffed toy": ("stuffed toy", "stuffed animal", "cuddly toy", "rag doll", "doll"),
    "leather bag": ("leather bag", "handbag", "purse", "leather case", "messenger bag", "bag"),
    "pouch": ("pouch", "small bag", "drawstring pouch", "zipper bag", "small round bag"),
    "shoe": ("shoe", "sneaker", "running shoe", "sports shoe", "lace-up shoe"),
    "slipper": ("slipper", "house shoe", "slide sandal", "felt slipper", "moccasin"),
    "cat figurine": ("cat figurine", "cat statue", "ceramic cat", "cat", "porcelain kitten"),
    "miniature house": ("miniature house", "toy house", "model house", "house", "little house"),
    "plant": ("plant", "potted plant", "houseplant", "cactus", "plant in a pot"),
    "scrubber": ("scrubber", "scrub brush", "dish brush", "scrubbing brush", "kitchen sponge"),
    "plastic bowl": ("plastic bowl", "bowl", "mixing bowl"),
    "plate": ("plate", "dinner plate", "dish"),
    "basket": ("basket", "wicker basket", "bread basket"),
    "painting": ("painting", "framed picture", "picture frame"),
    "toy bus": ("toy bus", "bus", "school bus"),
}
"""Training phrases of each category, its own name first.

A category without an entry is trained with its name alone.
"""

NEGATIVES: tuple[str, ...] = (
    "laptop", "keyboard", "book", "banana", "apple", "scissors", "spoon", "fork", "phone", "dog",
    "car", "table", "robot arm", "gripper", "person", "chair", "lamp", "window", "hat", "pillow",
    "clock", "ball", "cardboard box", "remote control", "toothbrush", "shadow", "wall", "umbrella",
    "elephant", "screwdriver", "notebook", "candle", "glasses", "key", "wallet", "headphones",
    "bread", "orange", "towel", "desk", "floor", "monitor", "mouse", "pen", "eraser", "ruler",
    "tape", "battery", "cable", "charger", "speaker", "microphone", "television", "sofa", "bed",
    "door", "knife", "pan", "kettle", "toaster", "fridge", "jar", "egg", "carrot", "tomato",
    "lemon", "cheese", "cake", "cookie", "milk carton", "shirt", "glove", "scarf", "belt", "ring",
    "watch", "comb", "soap", "shampoo", "tissue box", "trash can", "bucket", "broom", "drill",
    "wrench", "nail", "rope", "toy car", "airplane", "boat", "lego brick", "dice", "puzzle",
    "tennis ball", "football", "horse", "tree", "flower", "rock", "envelope", "magazine", "map",
    "coin", "credit card",
)  # fmt: skip
"""Phrases that name nothing in a training scene: the detector must find nothing for them."""

UNSEEN_NEGATIVES: tuple[str, ...] = (
    "bicycle",
    "pizza",
    "guitar",
    "hammer",
    "sock",
    "backpack",
    "hair dryer",
    "stapler",
    "calculator",
    "garden hose",
)
"""Phrases like `NEGATIVES` that are never trained with."""


def training_phrases(category: str) -> tuple[str, ...]:
    """The phrases that the detector is trained with for a category."""
    return SYNONYMS.get(category, (category,))

"""Parsing and rewriting, exactly."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vap_core.base.errors import BadInstruction
from vap_core.instruction import parse, rewrite, unite
from vap_core.instruction.rule import is_name
from vap_core.prompt import PALETTE

RED, BLUE = PALETTE[0], PALETTE[1]


@pytest.mark.parametrize(
    ("text", "category", "rewritten"),
    [
        ("bring my cup", "cup", "bring the red cup"),
        ("Bring my cup.", "cup", "Bring the red cup."),
        ("My cup, please", "cup", "The red cup, please"),
        ("pick up my owl figurine", "owl figurine", "pick up the red owl figurine"),
        ("put my straw cup on the plate", "straw cup", "put the red straw cup on the plate"),
        (
            "take my brother's dog figurine to the table",
            "dog figurine",
            "take the red dog figurine to the table",
        ),
        ("move my bottle near coke can", "bottle", "move the red bottle near coke can"),
        ("give me my  pen   holder now", "pen holder", "give me the red pen holder now"),
        ("bring MY CUP", "cup", "bring the red cup"),
        ("Bring My Cup.", "cup", "Bring the red cup."),
        ("Wait! My cup, please", "cup", "Wait! The red cup, please"),
        ("Wait. My cup; now", "cup", "Wait. The red cup; now"),
        ("Ready? MY CUP", "cup", "Ready? The red cup"),
        ("Please, My cup", "cup", "Please, the red cup"),
        ("fetch my teddy-bear", "teddy-bear", "fetch the red teddy-bear"),
    ],
)
def test_golden(text: str, category: str, rewritten: str) -> None:
    instruction = parse(text, ["cup", "straw cup", "pen holder"])
    assert [t.category for t in instruction.targets] == [category]
    assert rewrite(instruction, [RED]) == rewritten


def test_a_compound_of_a_known_category_is_another_category() -> None:
    (target,) = parse("bring my cup-holder", ["cup"]).targets
    assert target.category == "cup-holder"


def test_owner_is_kept() -> None:
    assert parse("bring my brother's cup").targets[0].owner == "my brother's"
    assert parse("bring my old brother's cup").targets[0].category == "cup"
    assert parse("bring my friend's brother's cup").targets[0].category == "cup"
    assert rewrite(parse("bring my friends' cup"), [RED]) == "bring the red cup"


@pytest.mark.parametrize(
    ("text", "category"),
    [
        ("put my hat near Anna's cup", "hat"),
        ("bring my phone and Anna's bag", "phone"),
        ("bring my hat from Anna's desk", "hat"),
    ],
)
def test_an_owner_ends_before_the_next_phrase(text: str, category: str) -> None:
    (target,) = parse(text, ["cup", "bag"]).targets
    assert (target.owner, target.category) == ("my", category)


@pytest.mark.parametrize("categories", [[], ["cup"], ["lamp"]])
@pytest.mark.parametrize("text", ["give my brother my cup", "Hand my old friend my cup, please"])
def test_who_gets_an_object_is_no_part_of_it(text: str, categories: list[str]) -> None:
    (target,) = parse(text, categories).targets
    assert (target.owner, target.category) == ("my", "cup")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("show my camera my plate", ["camera", "plate"]),
        ("bring my cup my plate and my bowl", ["cup", "plate", "bowl"]),
        ("bring my mug my sister gave me", ["mug", "sister gave me"]),
    ],
)
def test_an_object_that_nobody_registered_is_not_passed_over(text: str, found: list[str]) -> None:
    """It is a target, so that it is refused, and not the rest done without it."""
    assert [target.category for target in parse(text, ["plate", "bowl"]).targets] == found


def test_a_determiner_ends_a_category() -> None:
    (target,) = parse("show my camera the plate").targets
    assert target.category == "camera"
    assert parse("bring my cup my friend", ["cup"]).targets[0].category == "cup"
    assert parse("bring my the-one cup").targets[0].category == "the-one cup"


@pytest.mark.parametrize(("word", "category"), [("glasses", "glass"), ("boxes", "box")])
def test_every_plural_counts(word: str, category: str) -> None:
    assert parse(f"bring my {word}", [category]).targets[0].category == category


def test_several_targets() -> None:
    instruction = parse("put my pouch near my vase")
    assert [t.category for t in instruction.targets] == ["pouch", "vase"]
    assert rewrite(instruction, [RED, BLUE]) == "put the red pouch near the blue vase"
    assert rewrite(instruction, [None, BLUE]) == "put my pouch near the blue vase"


def test_longest_known_category_wins() -> None:
    assert (
        parse("bring my straw cup holder", ["cup", "straw cup"]).targets[0].category == "straw cup"
    )
    assert parse("bring my cup holder", ["cup", "cup holder"]).targets[0].category == "cup holder"


def test_plural_counts_as_the_category() -> None:
    assert rewrite(parse("bring my cups", ["cup"]), [RED]) == "bring the red cup"


@pytest.mark.parametrize(
    "text", ["", "bring the cup", "bring my", "mystery of the cup", "bring my and"]
)
def test_no_possessive_is_an_error_that_says_how(text: str) -> None:
    with pytest.raises(BadInstruction, match='name one as "my <category>"'):
        parse(text)


def test_colours_must_match_targets() -> None:
    with pytest.raises(BadInstruction, match="1 targets|one each"):
        rewrite(parse("bring my cup"), [RED, BLUE])


nouns = st.sampled_from(["cup", "vase", "owl figurine", "leather bag", "shoe"])


@given(nouns, nouns)
def test_renaming_an_object_rewrites_only_its_noun(one: str, other: str) -> None:
    first, second = (rewrite(parse(f"put my {noun} on the plate"), [RED]) for noun in (one, other))
    assert first.replace(one, other) == second


@given(st.text(alphabet=st.characters(codec="ascii", exclude_characters="\n"), max_size=30), nouns)
def test_the_rest_of_the_text_is_untouched(before: str, noun: str) -> None:
    text = f"{before} | my {noun}."
    try:
        instruction = parse(text)
    except BadInstruction:
        return
    if len(instruction.targets) == 1 and instruction.targets[0].category == noun:
        out = rewrite(instruction, [RED])
        assert out == f"{before} | the red {noun}."


@given(nouns)
def test_a_rewritten_instruction_has_nothing_left_to_rewrite(noun: str) -> None:
    with pytest.raises(BadInstruction):
        parse(rewrite(parse(f"bring my {noun}"), [RED]))


def test_targets_of_one_object_are_united() -> None:
    text = "My vase and my cup: put my vase near my cups, my vase first"
    parsed = parse(text, ["vase", "cup"])
    assert rewrite(unite(parsed, ["a", "b", "c", "d", "e"]), [*[None] * 4, RED]) == (
        "My vase and my cup: put my vase near my cups, the red vase first"
    )
    one = unite(parsed, ["ming", "mug", "ming", "mug", "ming"])
    assert [(target.category, len(target.again)) for target in one.targets] == [
        ("vase", 2),
        ("cup", 1),
    ]
    assert rewrite(one, [RED, BLUE]) == (
        "The red vase and the blue cup: put the red vase near the blue cup, the red vase first"
    )
    assert rewrite(one, [None, BLUE]) == (
        "My vase and the blue cup: put my vase near the blue cup, my vase first"
    )


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ("my cup", True),
        ("his cups", True),
        ("Anna's blue cup", True),
        ("the neighbour's cup", True),
        ("James’ cup", True),
        ("the cup", False),
        ("my favourite one", False),
        ("my cup-holder", False),
        ("it", False),
    ],
)
def test_a_name_is_a_possessive_and_a_category(said: str, named: bool) -> None:
    assert is_name(said, "cup") == named

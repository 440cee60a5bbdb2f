"""What notebooks show beside tables and charts: objects and episodes, kept pictures, controls.

What is chosen in a control counts when the next cell runs, as with a box that is dragged. Every
control begins with a default, so a notebook that nobody touches shows the same each time; where
there is no kernel, its default stands as words.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.attend import Prompting
from vap_core.base.errors import one_of, require
from vap_core.base.files import code_digest, write_atomic, writing
from vap_core.base.pictures import OTHER, ROLES, TEXT, TIER_COLOURS, WINNER, empty_figure
from vap_core.base.types import Grounding, Mask, PersonalObject, Rgb
from vap_core.perception.boxes import crop, mask_box, mask_iou
from vap_core.perception.protocols import Encoder
from vap_core.perception.references import Box
from vap_core.policies.scripted.expert import Expert
from vap_core.prompt import PALETTE, Tint
from vap_core.rollout.loop import rollout
from vap_core.rollout.running import expert_steps
from vap_core.rollout.types import Episode, Frame
from vap_core.simulation import robots, suites
from vap_core.simulation.assets.objects import (
    OBJECTS,
    TIERS,
    ObjectModel,
    get_object,
    lookalikes,
    personal_instance,
    tier,
)
from vap_core.simulation.control import pose_transform
from vap_core.simulation.studio import Shot, Stage, write_views
from vap_core.simulation.suites import BENCHMARKS, VARIANTS, WARM_UPS
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import EpisodeRow
from vap_core.study.charts import Tile, film
from vap_core.study.forms import draw_arrow, hand_pixel
from vap_core.study.grounding import grounding_figure as grounding_figure
from vap_core.study.inspection import highlighted
from vap_core.study.methods import ABLATIONS, DEFAULT
from vap_core.study.perception import View
from vap_core.study.register import draw_box
from vap_core.study.stats import share
from vap_core.study.store import encode_table
from vap_core.study.trials import Study, make_trial, register_personal

if TYPE_CHECKING:
    import pandas as pd
    from ipywidgets import Box as WidgetBox
    from jupyter_bbox_widget import BBoxWidget
    from matplotlib.figure import Figure
    from PIL import Image

STEMS = tuple(name.removesuffix("-personal") for name in OBJECTS if name.endswith("-personal"))
"""One per personal object: "pen-holder"."""
GOALS = tuple(model for model in OBJECTS.values() if model.split == "prop")
"""The models that serve as goals of tasks."""
VIEW_M = 0.6
"""How far a reference or a query is photographed from."""
REFERENCES = tuple(
    Shot(0.4 * np.pi * i, float(np.radians(elevation)), VIEW_M)
    for i, elevation in enumerate((18.0, 34.0, 50.0, 26.0, 42.0))
)
"""Five views from around an object, under one lamp, so that only the object differs."""
QUERIES = tuple(
    Shot(azimuth, float(np.radians(elevation)), VIEW_M)
    for azimuth, elevation in ((0.6, 40.0), (2.5, 30.0), (4.4, 35.0))
)
"""Views from between those."""


def lookalikes_by_tier(stem: str) -> tuple[ObjectModel, ...]:
    """A personal object's look-alikes, hard ones first."""
    return tuple(sorted(lookalikes(stem), key=lambda model: TIERS.index(tier(model))))


def lookalike_sheet(stage: Stage, goals: Sequence[ObjectModel] = ()) -> dict[str, list[Tile]]:
    """One row per personal object: itself, then its look-alikes from hard to easy.

    The title of a look-alike is its tier and the number in its name. `goals` are a last row.
    """
    rows = {}
    for stem in STEMS:
        personal = stage.picture(personal_instance(stem).name)
        rows[_label(stem)] = [Tile(personal, "personal", TIER_COLOURS["personal"])]
        for model in lookalikes_by_tier(stem):
            title = f"{tier(model)}, {model.name.rpartition('-')[2]}"
            rows[_label(stem)].append(
                Tile(stage.picture(model.name), title, TIER_COLOURS[tier(model)])
            )
    if goals:
        rows["goals"] = [Tile(stage.picture(goal.name), goal.category) for goal in goals]
    return rows


def object_sheet(
    models: Mapping[str, Sequence[ObjectModel]], size: int = 160
) -> dict[str, list[Tile]]:
    """One row per kind, with its objects."""
    with Stage([model for row in models.values() for model in row], size) as stage:
        return {
            _label(kind): [Tile(stage.picture(model.name)) for model in row]
            for kind, row in models.items()
        }


def reference_sheet(
    memory: Mapping[str, tuple[PersonalObject, tuple[int, ...]]],
) -> dict[str, list[Tile]]:
    """One row per remembered object: its crops; undetected ones are marked as whole photos."""
    marks = {True: ("whole photo", TIER_COLOURS["hard"]), False: ("", TIER_COLOURS["easy"])}
    return {
        _label(stem): [Tile(picture, *marks[i in whole]) for i, picture in enumerate(obj.crops)]
        for stem, (obj, whole) in memory.items()
    }


def _label(stem: str) -> str:
    return stem.removesuffix("-personal").replace("-", "\n").replace(" ", "\n")


def hardness(stage: Stage, encoder: Encoder) -> "pd.DataFrame":
    """How similar the encoder finds each look-alike to its personal object.

    The personal object is given by five references. One line per look-alike: `cosine`, the mean
    over queries and references; `own`, the same for the personal object's own queries; `fooled`,
    the share of votes that the look-alike would win, over every reference, view of the look-alike
    and view of the personal object.
    """
    import pandas as pd

    def embedded(name: str, shots: Sequence[Shot]) -> np.ndarray:
        """Of one object's crops, cut as grounding cuts its candidates."""
        return encoder([crop(stage.picture(name, shot), stage.box(name, shot)) for shot in shots])

    lines = []
    for stem in STEMS:
        personal = personal_instance(stem).name
        references = embedded(personal, REFERENCES)
        own = embedded(personal, QUERIES) @ references.T
        for model in lookalikes_by_tier(stem):
            cosines = embedded(model.name, QUERIES) @ references.T
            line: dict[str, Any] = {"object": stem.replace("-", " "), "lookalike": model.name}
            line |= {"tier": tier(model), "cosine": float(cosines.mean())}
            wins = cosines[:, None] > own[None]
            lines.append({**line, "own": float(own.mean()), "fooled": float(wins.mean())})
    return pd.DataFrame(lines)


def out_of_order(table: "pd.DataFrame") -> "pd.DataFrame":
    """Of `hardness`: pairs of one object's look-alikes whose tiers contradict their cosines.

    The easier one has the higher cosine. The widest gap comes first.
    """
    rank = table.assign(rank=table.tier.map(TIERS.index))
    pairs = rank.merge(rank, on="object", suffixes=("", "_easier"))
    wrong = pairs[(pairs["rank"] < pairs.rank_easier) & (pairs.cosine < pairs.cosine_easier)]
    wrong = wrong.assign(gap=wrong.cosine_easier - wrong.cosine).sort_values("gap", ascending=False)
    columns = ["lookalike", "tier", "lookalike_easier", "tier_easier", "gap"]
    return wrong[columns].reset_index(drop=True)


def census(lists: Mapping[str, Sequence[EpisodeRow]]) -> "pd.DataFrame":
    """One line per task and track of the suites' episode lists.

    Robot, cameras, control rate, instruction, rule, step limit, and the numbers of variants of the
    room and of episodes.
    """
    import pandas as pd

    tracks: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    for name, rows in lists.items():
        for row in rows:
            tracks.setdefault((name, row.task, row.split), []).append(row)
    lines = []
    for (name, _, split), rows in tracks.items():
        suite, row = BENCHMARKS[name], rows[0]
        line = {"suite": name, "robot": suite.robot, "cameras": len(suite.cameras)}
        line |= {"Hz": suite.hz, "instruction": row.instruction, "rule": row.rule}
        line |= {"steps": row.max_steps, "track": split or "-"}
        looks = len({row.variant for row in rows})
        lines.append({**line, "looks": looks, "episodes": len(rows)})
    return pd.DataFrame(lines)


def camera_images(row: EpisodeRow, steps: int = 0, size: int = 224) -> dict[str, Rgb]:
    """The images of the suite's cameras after `steps` control steps of the expert.

    The room is that of the row's variant, and the images pass the suite's sensor.

    Raises: UnknownName, as `open_row`; OutOfReach when the expert cannot reach its next pose.
    """
    expert = Expert()
    with open_row(row, image_size=size) as env:
        state = expert.start(np.random.default_rng([row.seed, row.episode]))
        for judge, _ in expert_steps(env, row, expert, state):
            if judge.steps == steps:
                break
        return dict(env.observe().images)


def frame_sheet(episodes: Sequence[Sequence[EpisodeRow]]) -> dict[str, list[Tile]]:
    """One row per suite: the opening frame of each of its `episodes`, by every camera.

    Raises: as `camera_images`.
    """
    rows = {}
    for of_suite in episodes:
        tiles = []
        for row in of_suite:
            for i, (camera, rgb) in enumerate(camera_images(row).items()):
                tiles.append(Tile(rgb, camera if i else f"{camera}: {row.instruction}"))
        rows[of_suite[0].suite] = tiles
    return rows


def same_layout(rows: Sequence[EpisodeRow], like: EpisodeRow) -> dict[str, EpisodeRow]:
    """The first row of every variant that places the objects of `like` as `like` does.

    Distractors may be added.
    """

    def poses(row: EpisodeRow) -> list[tuple[str, float, float, float]]:
        return [(place.model, place.x, place.y, place.yaw) for place in row.placements]

    wanted = poses(like)
    first: dict[str, EpisodeRow] = {}
    for row in rows:
        if row.task == like.task and poses(row)[: len(wanted)] == wanted:
            first.setdefault(row.variant, row)
    return {variant: first[variant] for variant in VARIANTS if variant in first}


def layouts_figure(
    lists: Mapping[str, Sequence[EpisodeRow]],
    tables_m: Mapping[str, tuple[float, float, float, float]],
) -> "Figure":
    """Where objects stand at the start, seen from above with the robot at the bottom.

    One panel per suite; `tables_m` are the x0 y0 x1 y1 of its table.
    """
    from matplotlib.patches import Rectangle

    figure = empty_figure(3.4 * len(lists), 3.9)
    grid = figure.subplots(1, len(lists), squeeze=False)[0]
    for axes, (name, rows) in zip(grid, lists.items(), strict=True):
        x0, y0, x1, y1 = tables_m[name]
        axes.add_patch(
            Rectangle((-y1, x0), y1 - y0, x1 - x0, facecolor="#f3ede4", edgecolor="#cdbfa8")
        )
        for role in ("other objects", "look-alike", "target", "goal"):
            spots = {
                (-place.y, place.x)
                for row in rows
                for i, place in enumerate(row.placements)
                if _role(row, i) == role
            }
            xy = np.array(sorted(spots)).reshape(-1, 2)
            goal = role == "goal"
            axes.scatter(
                *xy.T,
                label=role,
                s=45 if goal else 8,
                facecolor="none" if goal else ROLES[role],
                edgecolor=ROLES[role],
                linewidths=1.6 if goal else 0.0,
            )
        axes.plot(
            0, 0, marker="s", markersize=6, color=TEXT, linestyle="none", label="robot's base"
        )
        axes.set(xlim=(-0.36, 0.36), ylim=(-0.06, 0.72), aspect="equal")
        axes.set(title=f"{name}\n{len(rows)} episodes", xlabel="to the robot's right, m")
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("away from the robot, m")
    handles = grid[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=5, frameon=False, markerscale=2)
    return figure


def _role(row: EpisodeRow, number: int) -> str:
    """The role in ROLES of the object that `row` places as number `number`."""
    model = row.placements[number].model
    if number == 0 or model == row.goal:
        return "goal" if number else "target"
    return "look-alike" if "-lookalike-" in model else "other objects"


def choice_sheet(
    ways: Mapping[str, Mapping[str, Grounding]], views: Sequence[View]
) -> dict[str, list[Tile]]:
    """The candidates of every view, a row for each way to ground them; the highlighted one is
    orange, and the title names the object under it.
    """
    rows = {}
    for way, groundings in ways.items():
        tiles = []
        for view in views:
            grounding = groundings[view.camera]
            picture = view.rgb.copy()
            for i, box in enumerate(grounding.candidates.xyxy.tolist()):
                won = i == grounding.winner
                draw_box(picture, box, (242, 142, 43) if won else (160, 160, 160), 2 if won else 1)
            name = highlighted(view, grounding) or "none highlighted"
            tiles.append(Tile(picture, f"{view.camera}: {name}"))
        rows[way] = tiles
    return rows


def mask_sheet(views: Sequence[View], groundings: Mapping[str, Grounding]) -> list[Tile]:
    """Close-ups of the winner's mask against the target's visible pixels.

    Where they agree the picture is unchanged; missed pixels are orange, wrong ones blue.
    """
    from matplotlib.colors import to_rgb

    tiles = []
    for view in views:
        true, drawn = view.masks[view.row.target], groundings[view.camera].mask
        mask = np.zeros_like(true) if drawn is None else drawn
        picture = np.where((true & mask)[..., None], view.rgb, 110 + view.rgb // 3).astype(np.uint8)
        for wrong, colour in ((true & ~mask, WINNER), (mask & ~true, OTHER)):
            picture[wrong] = np.uint8(255 * np.array(to_rgb(colour)))
        text = "nothing highlighted" if drawn is None else f"IoU {mask_iou(mask, true):.2f}"
        if (true | mask).any():
            picture = picture[_around([true, mask], 10)]
        tiles.append(Tile(picture, f"{view.camera}: {text}"))
    return tiles


def _around(masks: Sequence[Mask], margin_px: int) -> tuple[slice, slice]:
    """The rows and columns of a square around all of the masks."""
    box = mask_box(np.any(masks, axis=0))
    assert box is not None
    x0, y0, x1, y1 = box.astype(int).tolist()
    side = max(x1 - x0, y1 - y0) // 2 + margin_px
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    return slice(max(0, y - side), y + side), slice(max(0, x - side), x + side)


def write_photo(folder: Path, row: EpisodeRow, camera: str) -> tuple[Path, Path]:
    """Write a photo to inspect, `row`'s opening frame through one camera, and the reference photos
    of its target; returns its path, and their folder. Raises: BadOutput.
    """
    from PIL import Image

    references, photo = folder / "references", folder / "photo.png"
    with writing(folder, "write_photo", "choose another folder"):
        write_views(get_object(row.target), references, replace=True)
        Image.fromarray(camera_images(row, size=448)[camera]).save(photo)
    return photo, references


ROUND_PX = 14
"""What is shown around the objects of the target's category."""


def marked_frames(row: EpisodeRow) -> dict[str, Rgb]:
    """The first camera's opening frame with every form of a prompt, by arm, the default first; cut
    to the objects alike. Masks are the true ones.

    Raises: UnknownName, as `open_row`.
    """
    base = robots.get(suites.suite(row.suite).robot).base_world
    with open_row(row) as env:
        camera = env.cameras()[0]
        rgb = env.observe().images[camera.name]
        masks = dict(env.truth(masks=True).masks[camera.name])
        start = hand_pixel(camera, pose_transform(base).apply(env.tcp_base()[:3, 3]))
    target = masks.pop(row.target)
    others = [masks[name] for name in masks if get_object(name).category == row.category]
    frames = {DEFAULT: Tint()(rgb, target, PALETTE[0], others)}
    for name in ("form", "opacity"):
        for arm, how in ABLATIONS[name].arms.items():
            if isinstance(how, Prompting):
                frames[arm] = how.form(rgb, target, PALETTE[0], others)
            elif start is not None:
                frames[arm] = draw_arrow(rgb, target, PALETTE[0], start)
    around = _around([target, *others], ROUND_PX)
    return {arm: frame[around] for arm, frame in frames.items()}


def run_episode(
    suite: str, task: str, number: int, *, bank: Path, method: str = "vap", policy: str = "mini-pi0"
) -> Episode:
    """One episode of a list with its pictures kept; the objects are remembered in `bank`.

    Raises: as `Study`, `register_personal` and `make_trial`.
    """
    study = Study(((suite, task),), (method,), policy=policy)
    register_personal(study, bank)
    rows = [row for row in suites.rows(suite, task, None) if row.episode == number]
    (episode,) = rollout(make_trial(study, rows, method, bank), rows, keep_images=True)
    return episode


def animate(films: Mapping[tuple[str, str], Sequence[Rgb]], path: Path) -> None:
    """Films side by side as a GIF of eight pictures a second, each below its caption.

    A film that ends earlier stays at its last picture, whose caption has the second text, too.
    """
    from PIL import Image, ImageDraw, ImageFont

    font, side_px = ImageFont.load_default(size=17), 320
    pages = []
    for i in range(max(map(len, films.values()))):
        page = Image.new("RGB", (len(films) * (side_px + 8) - 8, side_px + 28), "white")
        for at, ((caption, end), pictures) in enumerate(films.items()):
            if i + 1 >= len(pictures):
                caption += end
            shown = Image.fromarray(pictures[min(i, len(pictures) - 1)])
            page.paste(shown.resize((side_px, side_px)), (at * (side_px + 8), 28))
            ImageDraw.Draw(page).text((at * (side_px + 8) + 2, 4), caption, "black", font)
        pages.append(page.quantize(method=Image.Quantize.MAXCOVERAGE))
    durations = [125] * (len(pages) - 1) + [2000]
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=durations, loop=0)


def first_success(episodes: "pd.DataFrame", suite: str, policy: str) -> tuple[str, int]:
    """Task and number of VAP's first success in a list, in the list's order.

    The first episode stands for it where none succeeded.
    """
    found = episodes.query("suite == @suite and policy == @policy and method == 'vap'")
    line = found.sort_values("success", ascending=False, kind="stable").iloc[0]
    return str(line["task"]), int(line["episode"])


def steps_figure(episode: Episode, camera: str) -> "Figure":
    """A row of prompted pictures for each sub-goal, from its first to its last."""
    row = episode.header.row
    parts = [(row.instruction, episode)]
    if row.subgoals:
        parts = [
            (f"{i + 1}. {row.subgoals[i].instruction}", episode.part(i))
            for i in range(len(episode.subgoals))
        ]
    rows = {}
    for instruction, part in parts:
        words = instruction.split()
        middle = (len(words) + 1) // 2
        mark = "✓ success" if part.outcome.success else "✗ failure"
        label = f"{' '.join(words[:middle])}\n{' '.join(words[middle:])}\n{mark}"
        rows[label] = moments(part.frames, camera, 5)
    return film(rows, ["start", "", "", "", "end"])


def moments(frames: Sequence[Frame], camera: str, count: int = 6) -> list[Rgb]:
    """So many of the prompted pictures of one camera, evenly spread, the first and the last too."""
    seen = [frame.prompted[camera] for frame in frames if camera in frame.prompted]
    return [seen[round(i * (len(seen) - 1) / (count - 1))] for i in range(count)]


SVG_LIMIT = 300_000
"""Bytes; a larger drawing stays a PNG."""


def keep(
    figure: "Figure",
    path: Path,
    dpi: int = 110,
    limit: int = 480_000,
    small: int = 115_000,
    about: Mapping[str, str] | None = None,
) -> bytes:
    """Save a figure as a PNG of at most `limit` bytes; return a JPEG of at most `small` bytes.

    The JPEG is for a notebook; `about` becomes the PNG's text chunks. A figure without pictures is
    saved as an SVG, too, where it fits into SVG_LIMIT.
    """
    from matplotlib import rc_context
    from matplotlib.image import AxesImage

    if not figure.findobj(AxesImage):
        drawn = BytesIO()
        with rc_context({"svg.hashsalt": "vap_core", "svg.fonttype": "none"}):
            figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
        if drawn.tell() <= SVG_LIMIT:
            write_atomic(path.with_suffix(".svg"), drawn.getvalue())
    drawn = BytesIO()
    figure.savefig(drawn, dpi=dpi, metadata={"Software": None, **(about or {})})
    return keep_png(drawn.getvalue(), path, limit=limit, small=small)


def keep_png(drawn: bytes, path: Path, limit: int = 480_000, small: int = 115_000) -> bytes:
    """The same for a picture, with its text chunks.

    What is too large is saved with coarser colours (6 or 5 bits a channel), then with fewer pixels.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    source = Image.open(BytesIO(drawn))
    texts = PngInfo()
    for name, text in source.info.items():
        if isinstance(name, str) and isinstance(text, str):
            texts.add_text(name, text)
    full = source.convert("RGB")
    for part, bits in ((1.0, 8), (1.0, 6), (1.0, 5), (0.8, 6), (0.8, 5), (0.6, 5)):
        size = (round(part * full.width), round(part * full.height))
        resized = full.resize(size, Image.Resampling.LANCZOS)
        top = 2**bits - 1
        levels = [round(round(v / 255 * top) * 255 / top) for v in range(256)]
        png = BytesIO()
        resized.point(levels * 3).save(png, "PNG", optimize=True, pnginfo=texts)
        if png.tell() <= limit:
            break
    path.write_bytes(png.getvalue())
    return small_jpeg(full, small)


def small_jpeg(picture: "Image.Image", limit: int = 115_000) -> bytes:
    """An RGB picture as a JPEG of at most `limit` bytes, for a notebook; shrinks `picture`."""
    from PIL import Image

    for width in (1100, 1000, 880, 760, 640, 520, 400):
        picture.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
        jpeg = BytesIO()
        picture.save(jpeg, "JPEG", quality=84)
        if jpeg.tell() <= limit:
            break
    return jpeg.getvalue()


KEY = "vap_core.made_from"
"""The text chunk of a PNG and the metadata of a table that hold the digest."""
SOURCES = ("simulation/assets", "simulation/studio.py", "perception/embedded", "memory.py")
"""The code that decides how an object looks, and how its photos are cropped and embedded."""


@cache
def made_from() -> str:
    """A digest of `SOURCES`, of the shipped objects and of the shipped weights."""
    import vap_core
    from vap_core.perception.embedded.networks import FOLDER
    from vap_core.simulation.assets.objects import FORMS, ROWS

    package = Path(vap_core.__file__).parent
    found = hashlib.sha256((FOLDER / "manifest.json").read_bytes())
    for file in (ROWS, FORMS):
        found.update(file.read_bytes())
    for part in SOURCES:
        found.update(code_digest(package / part).encode())
    return found.hexdigest()[:16]


def kept_figure(
    path: Path, draw: Callable[[], "Figure"], *, again: bool = False, small: int = 115_000
) -> bytes:
    """The figure of a PNG as a JPEG of at most `small` bytes; drawn where the code and weights
    behind it have changed, or `again`.
    """
    from PIL import Image

    if not again and path.exists():
        with Image.open(path) as picture:
            if picture.info.get(KEY) == made_from():
                return small_jpeg(picture.convert("RGB"), small)
    return keep(draw(), path, small=small, about={KEY: made_from()})


def kept_table(
    path: Path, make: Callable[[], "pd.DataFrame"], *, again: bool = False
) -> "pd.DataFrame":
    """The table of a Parquet file; made where it is stale, or `again`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    key = KEY.encode()
    if not again and path.exists():
        table = pq.read_table(path)
        if (table.schema.metadata or {}).get(key) == made_from().encode():
            return table.to_pandas()
    made = pa.Table.from_pandas(make(), preserve_index=False)
    about = {**(made.schema.metadata or {}), key: made_from().encode()}
    write_atomic(path, encode_table(made.replace_schema_metadata(about)))
    return made.to_pandas()


ALL = "all"
"""In a dropdown: nothing is left out."""


class Control:
    """Widgets in a box, and the words that stand for them where there is no kernel."""

    def __init__(self, box: "WidgetBox", words: str) -> None:
        self.box = box
        self._words = words

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        data = dict(self.box._repr_mimebundle_(**options))
        html = f"<p><em>{escape(self._words)}</em></p>"
        return {**data, "text/plain": self._words, "text/html": html}


class EpisodeChoice(Control):
    """One episode of a suite's task, and one of its cameras; shared scenes are left out.

        where = EpisodeChoice("vlabench", "select-cup", 0, "front")
        suite, task, number, camera = where.chosen

    Raises: UnknownName for a default that there is not; MissingPart: the extra `notebooks` is not
        installed.
    """

    def __init__(self, suite_name: str, task: str, number: int = 0, camera: str = "front") -> None:
        require("notebooks", "a control")
        import ipywidgets

        known = suites.suite(suite_name)
        known.task(task)
        if camera not in known.cameras:
            raise one_of(f"EpisodeChoice: camera of {suite_name}", camera, known.cameras)
        names = list(dict.fromkeys([suite_name, *BENCHMARKS, *WARM_UPS]))
        self.suite = ipywidgets.Dropdown(options=names, value=suite_name, description="suite")
        self.task = ipywidgets.Dropdown(description="task")
        self.number = ipywidgets.BoundedIntText(
            value=number, min=0, max=10_000, description="episode"
        )
        self.camera = ipywidgets.Dropdown(description="camera")
        self._fill()
        self.task.value, self.camera.value = task, camera
        self.suite.observe(lambda _: self._fill(), names="value")
        words = f"suite {suite_name} · task {task} · episode {number} · camera {camera}"
        super().__init__(
            ipywidgets.HBox([self.suite, self.task, self.number, self.camera]),
            f"{words}: choose others in JupyterLab, then run on from the next cell.",
        )

    @property
    def chosen(self) -> tuple[str, str, int, str]:
        """Suite, task, number of the episode, camera."""
        return self.suite.value, self.task.value, self.number.value, self.camera.value

    def _fill(self) -> None:
        """The tasks and cameras of the chosen suite."""
        of_suite = suites.suite(self.suite.value)
        self.task.options = [task.name for task in of_suite.tasks]
        self.camera.options = list(of_suite.cameras)
        self.task.index = self.camera.index = 0


class OwnPhotos(Control):
    """A photo of one's own, photos of the object alone, and what kind of thing it is.

    `folder` is where what is chosen is kept; nothing leaves this machine.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """

    def __init__(self, folder: Path, category: str) -> None:
        require("notebooks", "a control")
        import ipywidgets

        images = {"accept": "image/*"}
        self.photo = ipywidgets.FileUpload(description="photo", **images)
        self.references = ipywidgets.FileUpload(multiple=True, description="its photos", **images)
        self.category = ipywidgets.Text(value=category, description="a kind of")
        self._folder = folder
        super().__init__(
            ipywidgets.HBox([self.photo, self.references, self.category]),
            "no photo of your own yet: choose a photo, and some of the object alone, in "
            "JupyterLab, then run on from the next cell.",
        )

    @property
    def chosen(self) -> tuple[Path | None, Path | None, str]:
        """The photo, the folder with photos of the object, its kind; None until both are there."""
        if not self.photo.value or not self.references.value:
            return None, None, self.category.value
        references = self._folder / "references"
        references.mkdir(parents=True, exist_ok=True)
        for old in references.iterdir():
            old.unlink()
        photos = {references / str(i): each for i, each in enumerate(self.references.value)}
        photos[self._folder / "photo"] = self.photo.value[0]
        for path, upload in photos.items():
            written = path.with_suffix(Path(upload.name).suffix.lower() or ".jpg")
            write_atomic(written, bytes(upload.content))
        return written, references, self.category.value


class Abstention(Control):
    """How many references, and how large a lead of the vote: what is answered, and rightly.

    `choices` is the survey's table of that name.

    Raises: UnknownName for a `k` that it does not have; MissingPart: the extra `notebooks` is not
        installed.
    """

    def __init__(self, choices: "pd.DataFrame", k: int = 5, threshold: float = 0.6) -> None:
        require("notebooks", "a control")
        import ipywidgets

        self._choices = choices
        numbers = sorted({int(number) for number in choices.k})
        if k not in numbers:
            raise one_of("Abstention: number of photos", str(k), numbers)
        names = [ALL, *dict.fromkeys(choices.suite)]
        self.suite = ipywidgets.Dropdown(options=names, value=ALL, description="suite")
        self.k = ipywidgets.SelectionSlider(options=numbers, value=k, description="photos K")
        self.threshold = ipywidgets.FloatSlider(
            value=threshold, min=0.0, max=1.0, step=0.05, description="least lead"
        )
        self.answer = ipywidgets.HTML(value=self._text())
        for each in (self.suite, self.k, self.threshold):
            each.observe(self._show, names="value")
        controls = ipywidgets.HBox([self.suite, self.k, self.threshold])
        super().__init__(ipywidgets.VBox([controls, self.answer]), self._text())

    def _text(self) -> str:
        """How many views are answered from a lead on, and how many of these rightly."""
        shown, k, threshold = self._choices, self.k.value, self.threshold.value
        if self.suite.value != ALL:
            shown = shown[shown.suite == self.suite.value]
        usual = shown[(shown.k == k) & (shown.rule == "vote")]
        answered = usual[(usual.elected != "") & (usual.margin >= threshold)]
        covered = share(usual.index.isin(answered.index))
        return (
            f"K = {k}, a lead of at least {threshold:.2f}: {covered.share_text()} views are "
            f"answered (95 % interval), {share(answered.right).share_text()} of these rightly."
        )

    def _show(self, _: Any) -> None:
        self.answer.value = self._text()


SIDE_PX = 800
"""The longer side of the photo whose box is dragged."""


def drag_box(photo: Rgb, box: Box, label: str) -> "BBoxWidget":
    """The photo with `box` on it; drag its corners or draw another one, then ask `dragged_box`.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """
    require("notebooks", "a box to drag")
    from jupyter_bbox_widget import BBoxWidget
    from PIL import Image

    image = Image.fromarray(photo)
    image.thumbnail((SIDE_PX, SIDE_PX))
    shown = BytesIO()
    image.save(shown, "JPEG", quality=90)
    x0, y0, x1, y1 = (box * min(1.0, SIDE_PX / max(photo.shape[:2]))).tolist()
    drawn = {"x": x0, "y": y0, "width": x1 - x0, "height": y1 - y0, "label": label}
    widget = BBoxWidget(classes=[label], bboxes=[drawn], hide_buttons=True)
    widget.image_bytes = shown.getvalue()
    return widget


def dragged_box(widget: "BBoxWidget", photo: Rgb) -> Box | None:
    """The last box of the widget, in the photo's pixels and inside it.

    None where none is left, or a side is less than a pixel: a click drags no box.
    """
    if not widget.bboxes:
        return None
    drawn = widget.bboxes[-1]
    x, y = drawn["x"], drawn["y"]
    scale = min(1.0, SIDE_PX / max(photo.shape[:2]))
    box = np.array([x, y, x + drawn["width"], y + drawn["height"]]) / scale
    height, width = photo.shape[:2]
    inside = np.clip(box, 0, (width, height, width, height)).astype(np.float32)
    return inside if (inside[2:] - inside[:2] >= 1).all() else None

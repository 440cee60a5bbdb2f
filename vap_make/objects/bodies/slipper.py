"""Slippers. Lengths are metres; the heel is at -x, the toe at +x."""

from typing import Literal

from vap_core.base.types import value
from vap_make.objects.bodies.parts import ellipsoid
from vap_make.objects.bodies.shoes import Knots, Last
from vap_make.objects.shapes import SIDES, Mesh, Solid, join_meshes
from vap_make.objects.textures import ACCENT, BASE, DARK, DECORATED, INK, SWATCHES

MULE_TOP: Knots = (
    (0, 0.40),
    (0.05, 0.43),
    (0.17, 0.57),
    (0.29, 0.70),
    (0.41, 0.84),
    (0.53, 0.97),
    (0.66, 0.99),
    (0.85, 0.80),
    (0.95, 0.60),
    (1, 0.45),
)
"""(Share of the length from the heel, share of the height)."""
BOOTIE_TOP: Knots = (
    (0, 0.86),
    (0.2, 0.88),
    (0.45, 1.0),
    (0.62, 0.86),
    (0.85, 0.72),
    (0.95, 0.56),
    (1, 0.42),
)
SOLID_CUTS: Knots = ((0.02, 0.27), (0.27, 0.52), (0.52, 0.78), (0.78, 0.93), (0.93, 0.99))
CHARM_SHARE = 0.72
"""Where a charm sits, from the heel."""
EAR, POMPOM = (0.0035, 0.0075, 0.0115), (0.0085, 0.0085, 0.0075)


@value
class Slipper:
    """A padded slipper with a closed toe: open at the heel (mule) or with a collar (bootie)."""

    length: float = 0.106
    width: float = 0.046
    height: float = 0.060
    sole: float = 0.009
    back: Literal["mule", "bootie"] = "mule"
    charm: Literal["none", "bow", "pompom", "ears", "band"] = "none"
    lining: Literal["light", "accent", "ink"] = "accent"

    def _last(self) -> Last:
        top = BOOTIE_TOP
        if self.back == "mule":
            top = MULE_TOP
        return Last(
            length=self.length,
            width=self.width,
            height=self.height,
            low=self.sole,
            top=top,
            power=2.3,
        )

    def mesh(self) -> Mesh:
        last = self._last()
        stop = 0.46
        if self.back == "mule":
            stop = 0.53
        opening = last.opening(
            start=0.05,
            stop=stop,
            share=0.78,
            trim=INK,
            inside=SWATCHES[self.lining],
            thickness=0.0036,
        )
        return join_meshes(
            [
                last.sole(INK, INK, flare=1.03),
                last.hull_mesh(DECORATED, rows=7),
                *opening,
                *self._charm_meshes(last),
            ]
        )

    def _charm_place(self, last: Last) -> tuple[float, float]:
        """x and z of the top line where a charm sits."""
        point = last.top_point(CHARM_SHARE)
        return float(point[0]), float(point[2])

    def _charm_meshes(self, last: Last) -> list[Mesh]:
        x, z = self._charm_place(last)
        match self.charm:
            case "bow":
                parts = []
                for side in SIDES:
                    wing = ellipsoid((0.0035, 0.0075, 0.005), ACCENT, segments=9, rows=5)
                    parts.append(wing.moved((x, side * 0.0075, z + 0.002)))
                knot = ellipsoid((0.0035, 0.003, 0.0035), INK, segments=8, rows=4)
                return [*parts, knot.moved((x + 0.0005, 0, z + 0.0025))]
            case "pompom":
                pompom = ellipsoid(POMPOM, ACCENT, segments=12, rows=6)
                return [pompom.moved((x, 0, z + 0.002))]
            case "ears":
                return self._animal_face(last)
            case "band":
                parts = []
                for side in SIDES:
                    lifts = (side * 0.98, 0)
                    parts.append(
                        last.patch((0.62, 0.76), lifts, ACCENT, raised=0.0008, size=(2, 6))
                    )
                return parts
            case "none":
                return []

    def _animal_face(self, last: Last) -> list[Mesh]:
        """Ears, eyes and a snout."""
        x, z = self._charm_place(last)
        parts = []
        for side in SIDES:
            ear = ellipsoid(EAR, BASE, segments=9, rows=5)
            lining = ellipsoid((0.003, 0.0045, 0.0075), INK, segments=8, rows=4)
            eye = ellipsoid((0.003, 0.0032, 0.0034), DARK, segments=8, rows=4)
            parts.append(ear.moved((x - 0.008, side * 0.0115, z + 0.003)))
            parts.append(lining.moved((x - 0.0065, side * 0.0115, z + 0.003)))
            parts.append(eye.moved(last.top_point(0.87, lift=0.34 * side)))
        snout = ellipsoid((0.004, 0.0045, 0.0035), INK, segments=9, rows=4)
        tip = last.top_point(0.94)
        return [*parts, snout.moved((float(tip[0]), 0, float(tip[2])))]

    def solids(self) -> tuple[Solid, ...]:
        last = self._last()
        return *last.solids(SOLID_CUTS), *self._charm_solids(last)

    def _charm_solids(self, last: Last) -> list[Solid]:
        x, z = self._charm_place(last)
        match self.charm:
            case "ears":
                ears = []
                for side in SIDES:
                    ears.append(Solid("ellipsoid", EAR, (x - 0.008, side * 0.0115, z + 0.003)))
                return ears
            case "pompom":
                return [Solid("ellipsoid", POMPOM, (x, 0, z + 0.002))]
            case "bow":
                return [Solid("ellipsoid", (0.0035, 0.014, 0.005), (x, 0, z + 0.002))]
            case _:
                return []

    def aspect(self) -> float:
        return self.length / (0.5 * self.width + 0.7 * self.height)

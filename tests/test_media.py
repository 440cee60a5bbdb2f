"""Pictures and videos from outside: one limit, their own colours, and no further file."""

import os
import struct
import time
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import av
import numpy as np
import pytest
import rerun as rr
from PIL import Image
from pillow_heif import from_pillow

from tests.command import refused
from vap_core.base.errors import BadPhoto, BadRecording
from vap_core.base.media import frame_rate, frames, load_mask, load_photo
from vap_core.recording.read import read_pictures
from vap_core.recording.stream import finish_stream, log_row, open_stream, time_columns

SRGB = np.array(
    [[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]]
)
"""Colorants of sRGB as columns, D50; below those of three wider spaces, with their gamma."""
SPACES = {
    "Display P3": (
        [[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]],
        2.2,
    ),
    "Adobe RGB": (
        [[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]],
        2.2,
    ),
    "ProPhoto RGB": (
        [[0.79767, 0.13519, 0.03135], [0.28804, 0.71187, 0.00009], [0.0, 0.0, 0.82521]],
        1.8,
    ),
}


def icc(colorants: np.ndarray, gamma: float) -> bytes:
    """A profile of a display: ICC.1, version 2."""

    def fixed(values: np.ndarray) -> bytes:
        return struct.pack(f">{len(values)}i", *np.round(65536 * values).astype(int).tolist())

    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * gamma)) + bytes(2)
    text = b"text" + bytes(4) + b"none\0\0\0\0"
    name = b"desc" + bytes(4) + struct.pack(">I", 5) + b"test\0" + bytes(78)
    tags = {b"desc": name, b"cprt": text, b"wtpt": b"XYZ " + bytes(4) + fixed(colorants.sum(1))}
    for i, colour in enumerate((b"r", b"g", b"b")):
        tags[colour + b"XYZ"] = b"XYZ " + bytes(4) + fixed(colorants[:, i])
        tags[colour + b"TRC"] = curve
    table, data, at = b"", b"", 132 + 12 * len(tags)
    for tag, entry in tags.items():
        padded = entry + bytes(-len(entry) % 4)
        table += tag + struct.pack(">II", at + len(data), len(entry))
        data += padded
    head = struct.pack(
        ">I4sI4s4s4s", at + len(data), b"none", 0x02400000, b"mntr", b"RGB ", b"XYZ "
    )
    head += bytes(12) + b"acsp" + bytes(28) + fixed(np.array([0.9642, 1.0, 0.8249])) + bytes(48)
    return head + struct.pack(">I", len(tags)) + table + data


def as_srgb(rgb: np.ndarray, colorants: np.ndarray, gamma: float) -> np.ndarray:
    """What a colour of a space is in sRGB, by the definition of both."""
    linear = np.linalg.solve(SRGB, colorants @ (rgb / 255) ** gamma).clip(0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(255 * encoded)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_the_profile_of_a_photo_is_applied(tmp_path: Path, space: str, mode: str) -> None:
    colorants, gamma = np.array(SPACES[space][0]), SPACES[space][1]
    for colour in ((128, 128, 128), (180, 120, 90), (110, 140, 100), (100, 110, 150)):
        path = tmp_path / "photo.png"
        picture = Image.new("RGB", (8, 8), colour)
        picture = picture.quantize() if mode == "P" else picture.convert(mode)
        picture.save(path, icc_profile=icc(colorants, gamma))
        expected = as_srgb(np.array(colour, float), colorants, gamma)
        assert np.abs(load_photo(path)[4, 4] - expected).max() <= 2, colour


def test_a_damaged_profile_says_nothing(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (180, 120, 90)).save(tmp_path / "a.png", icc_profile=b"no profile")
    assert load_photo(tmp_path / "a.png")[4, 4].tolist() == [180, 120, 90]


COLOUR = (180, 120, 90)
P3_CHRM = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)


def in_chunks(*chunks: tuple[bytes, bytes], colour: tuple[int, ...] = COLOUR) -> bytes:
    """A PNG with some chunks behind its header."""
    whole = BytesIO()
    Image.new("RGB", (8, 8), colour).save(whole, "PNG")
    added = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return whole.getvalue()[:33] + added + whole.getvalue()[33:]


def profiled(mode: str, level: int, profile: bytes, suffix: str = "PNG") -> bytes:
    whole = BytesIO()
    Image.new("L", (8, 8), level).convert(mode).save(whole, suffix, icc_profile=profile)
    return whole.getvalue()


def avif(primaries: int, transfer: int) -> bytes:
    whole = BytesIO()
    Image.new("RGB", (64, 64), COLOUR).save(whole, "AVIF", quality=100, subsampling="4:4:4")
    data = bytearray(whole.getvalue())
    struct.pack_into(">HH", data, data.index(b"colrnclx") + 8, primaries, transfer)
    return bytes(data)


def heic(primaries: int) -> bytes:
    whole = BytesIO()
    from_pillow(Image.new("RGB", (64, 64), COLOUR)).save(
        whole, quality=100, color_primaries=primaries, transfer_characteristics=13
    )
    return whole.getvalue()


def of_camera() -> bytes:
    """A JPEG whose EXIF says Adobe RGB by DCF's option, as cameras write it."""
    whole, about = BytesIO(), Image.Exif()
    about.get_ifd(0x8769)[0xA001] = 0xFFFF
    about.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.new("RGB", (8, 8), COLOUR).save(whole, "JPEG", quality=100, exif=about)
    return whole.getvalue()


def grey_icc() -> bytes:
    """A profile of grey pictures in linear light."""
    whole = icc(np.array(SPACES["Display P3"][0]), 1.0).replace(b"RGB XYZ ", b"GRAYXYZ ")
    return whole.replace(b"rTRC", b"kTRC")


P3_SRGB = (190, 117, 84)
"""COLOUR of Display P3, by its definition."""
DECLARED: dict[str, tuple[bytes, tuple[int, ...]]] = {
    "grey profile, with alpha": (profiled("LA", 128, grey_icc()), (188,) * 3),
    "grey profile, without": (profiled("L", 128, grey_icc(), "JPEG"), (188,) * 3),
    "profile of colours on grey": (
        profiled("L", 128, icc(np.array(SPACES["ProPhoto RGB"][0]), 1.8), "JPEG"), (146,) * 3
    ),
    "profile of other pictures": (profiled("CMYK", 255, icc(SRGB, 1.0), "JPEG"), (255,) * 3),
    "gAMA": (in_chunks((b"gAMA", struct.pack(">I", 100_000)), colour=(55,) * 3), (128,) * 3),
    "gAMA of sRGB": (in_chunks((b"gAMA", struct.pack(">I", 45455))), COLOUR),
    "sRGB beside gAMA": (
        in_chunks((b"sRGB", b"\0"), (b"gAMA", struct.pack(">I", 100_000))), COLOUR
    ),
    "cHRM": (in_chunks((b"gAMA", struct.pack(">I", 45455)), (b"cHRM", P3_CHRM)), (192, 117, 83)),
    "cICP": (in_chunks((b"cICP", bytes([12, 13, 0, 1]))), P3_SRGB),
    "cICP beside a profile": (
        in_chunks(
            (b"cICP", bytes([1, 13, 0, 1])), (b"iCCP", b"x\0\0" + zlib.compress(icc(SRGB, 1.0)))
        ),
        COLOUR,
    ),
    "AVIF": (avif(12, 13), P3_SRGB),
    "HEIC": (heic(12), P3_SRGB),
    "Adobe RGB of a camera": (of_camera(), (199, 120, 87)),
}  # fmt: skip


@pytest.mark.parametrize("kind", DECLARED)
def test_what_a_photo_declares_of_its_colours_is_applied(tmp_path: Path, kind: str) -> None:
    data, expected = DECLARED[kind]
    (tmp_path / "photo").write_bytes(data)
    assert np.abs(load_photo(tmp_path / "photo")[4, 4].astype(int) - expected).max() <= 2


def test_colours_that_are_not_read_are_refused_by_number(tmp_path: Path) -> None:
    for codes in ((22, 13), (9, 16)):
        (tmp_path / "photo.png").write_bytes(in_chunks((b"cICP", bytes([*codes, 0, 1]))))
        said = f"photo.png declares colours {codes[0]}/{codes[1] if codes[1] == 16 else 1} of ITU-T"
        with pytest.raises(BadPhoto, match=said):
            load_photo(tmp_path / "photo.png")


def test_a_damaged_photo_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    whole = BytesIO()
    Image.new("RGB", (8, 16), COLOUR).save(whole, "JPEG", quality=100)
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x05\x01"
    part = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    (tmp_path / "a.jpg").write_bytes(whole.getvalue()[:2] + part + whole.getvalue()[2:])
    assert load_photo(tmp_path / "a.jpg").shape == (16, 8, 3)
    assert capfd.readouterr() == ("", "")
    assert not recwarn


CORNER = np.zeros((32, 64, 3), np.uint8)
CORNER[:8, :8, 1] = 255


def coded(
    path: Path, rgb: np.ndarray, matrix: int = 2, wide: int = 0, codes: tuple[int, int] = (2, 2)
) -> Path:
    """A video of one picture by a matrix and a range (2 is full), as it says, and says of colours."""
    red, blue = {2: (0.299, 0.114), 6: (0.299, 0.114), 1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}[
        matrix
    ]
    r, g, b = np.moveaxis(rgb / 255, 2, 0)
    luma = red * r + (1 - red - blue) * g + blue * b
    chroma = (b - luma) / (2 - 2 * blue), (r - luma) / (2 - 2 * red)
    levels = [255 * luma, *(128 + 255 * part for part in chroma)]
    if wide != 2:
        levels = [16 + 219 * luma, *(128 + 224 * part for part in chroma)]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"qp": "0"})
        stream.height, stream.width, stream.pix_fmt = *rgb.shape[:2], "yuv444p"
        codec = stream.codec_context
        codec.colorspace, codec.color_range = matrix, wide
        codec.color_primaries, codec.color_trc = codes
        frame = av.VideoFrame(*rgb.shape[1::-1], "yuv444p")
        frame.colorspace, frame.color_range = matrix, wide
        for plane, level in zip(frame.planes, levels, strict=True):
            plane.update(np.round(level).clip(0, 255).astype(np.uint8).tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    ("given", "matrix", "wide", "codes", "expected"),
    [
        ((180, 60, 40), 1, 1, (1, 1), (180, 60, 40)),  # it was 170, 48, 41
        ((180, 60, 40), 1, 2, (1, 1), (180, 60, 40)),
        ((180, 60, 40), 6, 1, (1, 1), (180, 60, 40)),
        ((180, 60, 40), 6, 2, (1, 1), (180, 60, 40)),
        ((180, 60, 40), 9, 1, (1, 1), (180, 60, 40)),
        (COLOUR, 1, 1, (12, 13), P3_SRGB),
        ((191, 191, 191), 9, 1, (9, 18), (255, 255, 255)),  # HLG, white
    ],
)
def test_the_colours_of_a_video_are_as_it_says(
    tmp_path: Path, given: tuple[int, ...], matrix: int, wide: int, codes, expected
) -> None:
    path = coded(tmp_path / "a.mp4", np.full((32, 64, 3), given, np.uint8), matrix, wide, codes)
    (rgb,) = frames(path)
    assert np.abs(rgb[9, 9].astype(int) - expected).max() <= 3


ONE = 65536
TURNS = {
    "0": ((ONE, 0, 0, ONE), lambda rgb: rgb),
    "90": ((0, ONE, -ONE, 0), lambda rgb: np.rot90(rgb, -1)),
    "180": ((-ONE, 0, 0, -ONE), lambda rgb: np.rot90(rgb, 2)),
    "270": ((0, -ONE, ONE, 0), lambda rgb: np.rot90(rgb)),
    "mirrored": ((-ONE, 0, 0, ONE), np.fliplr),
    "upside down": ((ONE, 0, 0, -ONE), np.flipud),
    "transposed": ((0, ONE, ONE, 0), lambda rgb: rgb.transpose(1, 0, 2)),
    "zero": ((0, 0, 0, 0), lambda rgb: rgb),
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_video_is_turned_and_mirrored_as_it_says(tmp_path: Path, turn: str) -> None:
    (a, b, c, d), turned = TURNS[turn]
    data = bytearray(coded(tmp_path / "a.mp4", CORNER).read_bytes())
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, a, b, 0, c, d, 0, 0, 0, 1 << 30)
    (tmp_path / "a.mp4").write_bytes(data)
    (rgb,) = frames(tmp_path / "a.mp4")
    expected = turned(CORNER)
    assert rgb.shape == expected.shape
    assert ((rgb[..., 1] > 127) == (expected[..., 1] > 127)).all()


def claims(side: int) -> bytes:
    """A small JPEG that says that it has side x side pixels."""
    whole = BytesIO()
    Image.new("RGB", (16, 16)).save(whole, "JPEG")
    data = bytearray(whole.getvalue())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", side, side)
    return bytes(data)


def film(path: Path, side: int, codec: str, n: int = 3, **options: str) -> list[bytes]:
    """A video of grey frames, and its packets."""
    packets = []
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width = stream.height = side
        stream.pix_fmt = "yuv420p"
        for _ in range(n):
            frame = av.VideoFrame(side, side, "yuv420p")
            for plane in frame.planes:
                plane.update(bytes([128]) * plane.buffer_size)
            packets += stream.encode(frame)
        packets += stream.encode(None)
        found = [bytes(packet) for packet in packets]
        container.mux(packets)
    return found


def recording(path: Path, archetypes: list[rr.AsComponents]) -> Path:
    rec = open_stream(path, "test")
    for i, archetype in enumerate(archetypes):
        entity = "/observation.images.front/prompted"
        log_row(rec, entity, archetype, at=time_columns([(i, i / 10)]))
    finish_stream(rec, path)
    return path


@pytest.mark.parametrize("side", [8000, 20_000, 60_000])
def test_a_picture_inside_a_recording_has_the_limit_of_photos(tmp_path: Path, side: int) -> None:
    """60,000 squared ended `view --mp4` and `report`; 20,000 squared took 6 GB."""
    blob = claims(side)
    (tmp_path / "a.jpg").write_bytes(blob)
    with pytest.raises(BadPhoto, match=r"a\.jpg has .*pixels, over 50 million"):
        load_photo(tmp_path / "a.jpg")
    stills = [rr.EncodedImage(contents=blob, media_type="image/jpeg")] * 3
    path = recording(tmp_path / "big.rrd", stills)
    with pytest.raises(BadRecording, match=r"big\.rrd has .*pixels, over 50 million"):
        read_pictures(path, {"/observation.images.front/prompted"})
    assert "over 50 million" in refused("view", path, "--mp4", tmp_path / "out.mp4")
    assert not (tmp_path / "out.mp4").exists()


def test_a_video_has_a_limit_in_a_file_and_in_a_recording(tmp_path: Path) -> None:
    fast = {"preset": "ultrafast"}
    film(tmp_path / "large.mp4", 4096, "libx264", **fast)
    for read in (lambda path: list(frames(path)), frame_rate):
        with pytest.raises(BadPhoto, match=r"large\.mp4 has 4096x4096 pixels a frame, over 9\.4 m"):
            read(tmp_path / "large.mp4")
    packets = film(tmp_path / "av1.mp4", 4096, "libsvtav1", preset="13")
    streams: list[rr.AsComponents] = [
        rr.VideoStream(codec=rr.VideoCodec.AV1, sample=packet) for packet in packets
    ]
    with pytest.raises(BadRecording, match=r"large\.rrd holds a video .*at most 9\.4 million"):
        read_pictures(
            recording(tmp_path / "large.rrd", streams), {"/observation.images.front/prompted"}
        )
    film(tmp_path / "small.mp4", 64, "libx264", **fast)
    assert [rgb.shape for rgb in frames(tmp_path / "small.mp4")] == [(64, 64, 3)] * 3


LISTS: dict[str, Callable[[str], str]] = {
    "ffconcat": lambda name: f"ffconcat version 1.0\nfile {name}\n",
    "m3u8": lambda name: f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{name}\n#EXT-X-ENDLIST\n",
    "mpd": lambda name: (
        f'<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011">{name}</MPD>'
    ),
    "xspf": lambda name: f"<playlist><trackList><location>{name}</location></trackList></playlist>",
    "asx": lambda name: f"<asx><entry><ref href='{name}'/></entry></asx>",
    "pls": lambda name: f"[playlist]\nFile1={name}\nNumberOfEntries=1\n",
    "sdp": lambda name: "v=0\nc=IN IP4 127.0.0.1\nm=video 5000 RTP/AVP 96\n",
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", LISTS)
def test_a_list_of_files_is_no_video(tmp_path: Path, kind: str) -> None:
    """One opened its neighbours, and waited for a pipe."""
    film(tmp_path / "neighbour.mp4", 64, "libx264")
    os.mkfifo(tmp_path / "pipe")
    for name in ("neighbour.mp4", "pipe"):
        (tmp_path / "clip.mp4").write_text(LISTS[kind](name))
        with pytest.raises(BadPhoto, match=r"clip\.mp4 cannot be decoded"):
            list(frames(tmp_path / "clip.mp4"))


def test_a_file_named_like_a_protocol_is_a_file(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", 64, "libx264")
    (tmp_path / "a.mp4").rename(tmp_path / "concat:a|b.mp4")
    assert len(list(frames(tmp_path / "concat:a|b.mp4"))) == 3


def test_a_mask_of_49_megapixels_is_read_in_seconds(tmp_path: Path) -> None:
    """It took 27 s; a photo of as many pixels is the yardstick."""
    pixels = np.zeros((7000, 7000, 3), np.uint8)
    pixels[2000:4000, 1000:3000] = (255, 255, 0)
    pixels[5000:, :, 0] = 255
    Image.fromarray(pixels).save(tmp_path / "mask.png", compress_level=1)
    seconds = []
    for load in (load_photo, load_mask):
        began = time.process_time()
        found = load(tmp_path / "mask.png")
        seconds.append(time.process_time() - began)
    assert found.sum() == 2000 * 2000
    assert seconds[1] < 4 * seconds[0]

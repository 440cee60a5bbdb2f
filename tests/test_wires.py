"""The wires of policy servers: exact bytes, conventions in numbers, and everything that is refused."""

import struct
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from vap_core.base.errors import BadMessage, BadPolicy, UnknownName, VapError
from vap_core.policies import wire_map
from vap_core.policies.protocol import PolicyInput
from vap_core.policies.served import parse_address
from vap_core.policies.wire_map import MAPS, WireMap, load_map
from vap_core.policies.wires import (
    LARGEST_MESSAGE,
    WIRES,
    Message,
    array_of,
    at,
    decoded,
    like,
    node_of,
    pack,
    put,
    unpack,
)
from vap_core.simulation.types import EE_ACTION

OPENPI, VLA_EVAL = WIRES["openpi"], WIRES["vla-eval"]
RGB = np.arange(16 * 20 * 3, dtype=np.uint8).reshape(16, 20, 3)
DOWN = np.diag([1.0, -1.0, -1.0])


def test_an_array_of_openpi_has_the_bytes_that_its_client_writes() -> None:
    packed = OPENPI.write(Message("observation", {"a": np.float32([1, 2])}))
    wanted = b"\x81\xa1a\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x08" + struct.pack("<2f", 1, 2)
    wanted += b"\xc4\x05dtype\xa3<f4\xc4\x05shape\x91\x02"
    assert packed == wanted
    assert_array_equal(decoded(unpack(wanted))["a"], np.float32([1, 2]))


def test_vla_eval_has_an_envelope_that_a_reply_repeats() -> None:
    frame = VLA_EVAL.write(Message("action", {"actions": np.float64([3])}, {"seq": 7}))
    tree = msgpack.unpackb(frame)
    assert (tree["type"], tree["seq"]) == ("action", 7)
    assert tree["payload"]["actions"]["__ndarray__"] is True
    message = VLA_EVAL.read(frame, of_client=False)
    assert (message.kind, message.seq) == ("action", 7)
    hello = msgpack.unpackb(VLA_EVAL.write(Message("hello", {})))
    assert hello["payload"]["protocol_version"] == 1


@pytest.mark.parametrize("wire", WIRES.values(), ids=list(WIRES))
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_what_is_not_touched_passes_bit_for_bit(wire, data) -> None:
    kinds = st.sampled_from([np.uint8, np.float32, np.float64, np.int64, np.bool_])
    arrays = hnp.arrays(kinds, hnp.array_shapes(max_dims=4, max_side=5))
    leaf = st.one_of(st.none(), st.booleans(), st.integers(-(2**63), 2**63), st.text(), arrays)
    leaf |= st.floats(allow_nan=False) | st.binary()
    payload = data.draw(st.dictionaries(st.text(), leaf, max_size=5))
    frame = wire.write(Message("observation", payload, {"seq": 1, "timestamp": 2.0}))
    read = wire.read(frame, of_client=True)
    assert wire.write(read) == frame
    for name, array in payload.items():
        if isinstance(array, np.ndarray):
            assert_array_equal(array_of(read.payload[name]), array)


def test_an_encoded_picture_is_read_and_takes_its_place_without_loss() -> None:
    from io import BytesIO

    from PIL import Image

    for form in ("png", "jpeg"):
        file = BytesIO()
        Image.fromarray(RGB).save(file, form)
        node = {"__image__": True, "format": form, "data": file.getvalue(), "shape": [16, 20, 3]}
        assert array_of(node).shape == RGB.shape
        assert_array_equal(array_of(like(node, RGB)), RGB)
    raw = {**node_of(RGB, str), "__image__": True, "format": "raw"}
    assert_array_equal(array_of(like(raw, 255 - RGB)), 255 - RGB)


ARRAY = node_of(RGB, str)
BAD_ARRAYS = [
    ({**ARRAY, "dtype": "|O"}, "an array of type '\\|O'"),
    ({**ARRAY, "dtype": "<c8"}, "an array of type"),
    ({**ARRAY, "dtype": "V4"}, "an array of type"),
    ({**ARRAY, "shape": [10**9, 10**9]}, "bytes say that they are"),
    ({**ARRAY, "shape": [-1, 960]}, "or no sizes"),
    ({**ARRAY, "shape": "16"}, "or no sizes"),
    ({**ARRAY, "data": "text"}, "or no sizes"),
    ({b"__npgeneric__": True, b"data": [1], b"dtype": "<f4"}, "or no sizes"),
    ({"__image__": True, "format": "png", "data": b"GIF89a", "shape": [1, 1, 3]}, "a picture"),
]


@pytest.mark.parametrize(("node", "words"), BAD_ARRAYS, ids=range(len(BAD_ARRAYS)))
def test_an_array_that_lies_is_refused(node, words: str) -> None:
    with pytest.raises(BadMessage, match=words):
        array_of(node)


def nested(depth: int) -> bytes:
    return b"\x81\xa1a" * depth + b"\xc0"


BAD_FRAMES = [
    (OPENPI, b"", "are no message in msgpack"),
    (OPENPI, b"\xc1", "are no message in msgpack"),
    (OPENPI, b"\x93\x01\x02\x03", "sends a map"),
    (OPENPI, b"\xdf\xff\xff\xff\xff", "are no message in msgpack"),
    (OPENPI, b"\xc6\xff\xff\xff\xff1", "are no message in msgpack"),
    (OPENPI, nested(40), "more than 16 maps"),
    (OPENPI, nested(5000), "are no message in msgpack"),
    (VLA_EVAL, "a text", "is it openpi's"),
    (VLA_EVAL, msgpack.packb({"type": "act"}), "Is it openpi's wire"),
    (VLA_EVAL, msgpack.packb({"type": "action", "payload": {}, "seq": "1"}), "number of the mess"),
]


@pytest.mark.parametrize(("wire", "frame", "words"), BAD_FRAMES, ids=range(len(BAD_FRAMES)))
def test_a_damaged_message_is_refused_in_a_line(wire, frame, words: str) -> None:
    with pytest.raises(BadMessage, match=words) as caught:
        wire.read(frame, of_client=True)
    assert "\n" not in str(caught.value)


def test_a_message_has_a_limit() -> None:
    with pytest.raises(BadMessage, match="at most 64 are read"):
        unpack(bytes(LARGEST_MESSAGE + 1))


def test_paths() -> None:
    tree = put(put({"a": {"b": 1}}, ("a", "c"), 2), ("d",), 3)
    assert tree == {"a": {"b": 1, "c": 2}, "d": 3}
    assert at(tree, ("a", "c")) == 2
    assert at(tree, ("d", "x")) is None


# Our state of a Panda: x y z, turn from pointing down, opening, seven joints.
STATE = np.float32([0.5, 0.1, 0.3, 0, 0, np.pi / 2, 0.25, 0, 0.1, 0, -2.0, 0, 2.1, 0.7])
GIVEN = PolicyInput({"front": RGB, "side": RGB, "wrist": 255 - RGB}, "pick up my cup", STATE)
JOINTS = (*tuple(f"joint{i}" for i in range(7)), "gripper")
TURN = Rotation.from_matrix(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix() @ DOWN)
GOLDEN = {
    # map: its control, numbers sent by key, an action as it comes, and ours
    "libero": (
        EE_ACTION,
        {"observation/state": [0.5, 0.1, 0.3, *TURN.as_rotvec(), 0.01, -0.01]},
        [1, -0.5, 0, 0, 0, 0.5, 1.0],
        [0.05, -0.025, 0, 0, 0, 0.25, 0.0],
    ),
    "droid": (
        JOINTS,
        {
            "observation/joint_position": STATE[7:].tolist(),
            "observation/gripper_position": [0.75],
        },
        [0.5, 0, 0, 0, 0, 0, -1, 0.25],
        [0.1, 0, 0, 0, 0, 0, -0.2, 0.75],
    ),
    "bridge": (
        EE_ACTION,
        {"states": [0.5, 0.1, 0.3, *TURN.as_quat(scalar_first=True), 0.25]},
        [0.01, 0.02, 0.03, 0, 0, 0.1, 1.0],
        [0.01, 0.02, 0.03, 0, 0, 0.1, 1.0],
    ),
    "fractal": (
        EE_ACTION,
        {"states": [0.5, 0.1, 0.3, *TURN.as_quat(scalar_first=True), 0.25]},
        [0, 0, -0.04, 0, 0.2, 0, 0.0],
        [0, 0, -0.04, 0, 0.2, 0, 0.0],
    ),
    "ours": (JOINTS, {"observation.state": STATE.tolist()}, [0.1] * 8, [0.1] * 8),
    "ours-vla-eval": (EE_ACTION, {"state": STATE.tolist()}, [0.1] * 7, [0.1] * 7),
}


def test_every_map_that_ships_has_a_golden_trace() -> None:
    assert GOLDEN.keys() == MAPS.keys()


@pytest.mark.parametrize("name", MAPS)
def test_a_map_in_numbers(name: str) -> None:
    names, sent, action, ours = GOLDEN[name]
    convention = MAPS[name]
    convention.check(list(GIVEN.images), names, {})
    request = convention.request(GIVEN, DOWN)
    assert at(request, convention.text) == "pick up my cup"
    for key, numbers in sent.items():
        assert request[key].dtype == np.float32
        assert_allclose(request[key], numbers, atol=1e-6)
    for camera, (path, picture) in convention.by_camera(list(GIVEN.images)).items():
        shown = at(request, path)
        assert shown.dtype == np.uint8
        assert shown.flags.c_contiguous
        if picture.size is None:
            assert_array_equal(shown, GIVEN.images[camera])
        else:  # 16 x 20 in a square of 224: 179 rows, black above and below
            assert shown.shape == (224, 224, 3)
            assert not shown[:22].any()
            assert not shown[-22:].any()
    chunk = convention.chunk(np.array([action, action]), GIVEN, names)
    assert chunk.shape == (2, len(names))
    assert chunk.dtype == np.float32
    assert_allclose(chunk[0], ours, atol=1e-6)


def test_a_policy_gets_back_what_a_map_sends() -> None:
    for name in ("ours", "ours-vla-eval"):
        again = MAPS[name].observation(MAPS[name].request(GIVEN, DOWN), list(GIVEN.images))
        assert again.text == GIVEN.text
        assert_array_equal(again.state, GIVEN.state)
        for camera, rgb in GIVEN.images.items():
            assert_array_equal(again.images[camera], rgb)


def test_a_position_in_the_environments_own_frame() -> None:
    request = MAPS["libero"].request(GIVEN, DOWN, (-0.5, 0.0, 0.4))
    assert_allclose(request["observation/state"][:3], [0.0, 0.1, 0.7], atol=1e-6)


def test_the_axis_of_a_turn_has_a_positive_x_as_in_liberos_data() -> None:
    for tilt in (-0.05, 0.05):
        state = STATE.copy()
        state[3:6] = [tilt, 0, 0]
        request = MAPS["libero"].request(PolicyInput(GIVEN.images, "", state), DOWN)
        turn = request["observation/state"][3:6].astype(np.float64)
        assert_allclose(turn, [np.pi + tilt, 0, 0], atol=1e-5)
        wanted = Rotation.from_rotvec([tilt, 0, 0]).as_matrix() @ DOWN
        assert_allclose(Rotation.from_rotvec(turn).as_matrix(), wanted, atol=1e-5)


def test_joint_targets_become_steps_from_where_the_arm_is() -> None:
    convention = replace_map(actions=("joints", "closing"))
    first = STATE[7:] + 0.1
    chunk = convention.chunk(np.stack([[*first, 0], [*(first + 0.05), 1]]), GIVEN, JOINTS)
    assert_allclose(chunk[:, :7], [[0.1] * 7, [0.05] * 7], atol=1e-6)
    assert_allclose(chunk[:, 7], [1, 0])


def test_turned_pictures_with_channels_first() -> None:
    picture = wire_map.Picture(key=("image",), turned=True, first=True)
    convention = replace_map(pictures=(picture,), state=())
    request = convention.request(GIVEN, DOWN)
    assert_array_equal(request["image"], RGB[::-1, ::-1].transpose(2, 0, 1))
    assert_array_equal(convention.observation(request, ["front"]).images["front"], RGB)


def replace_map(**changes) -> WireMap:
    return MAPS["ours"].model_copy(update=changes)


def refuse(call, error: type[VapError], words: str) -> None:
    with pytest.raises(error, match=words):
        call()


def test_what_a_map_refuses(tmp_path: Path) -> None:
    libero, bridge = MAPS["libero"], MAPS["bridge"]
    good = MAPS["ours"].model_dump_json()
    file = tmp_path / "map.json"

    def written(text: str) -> WireMap:
        file.write_text(text)
        return load_map(str(file))

    assert written(good) == MAPS["ours"]
    one = {"cameras": ["front"], "names": EE_ACTION, "metadata": {}}
    wrong = {"action_spec": {"gripper": {"format": "binary_close_positive"}}}
    raw = {"action_spec": {"actions": {"format": "raw"}}}
    bridge.check(["front"], EE_ACTION, raw)
    row = np.zeros((1, 7))
    for call, error, words in [
        (lambda: libero.check(**one), BadPolicy, "the picture of camera wrist"),
        (lambda: bridge.check(["front"], JOINTS, {}), BadPolicy, "the other control"),
        (lambda: bridge.check(["front"], EE_ACTION, wrong), BadPolicy, "of that server"),
        (lambda: bridge.chunk(row[:, :5], GIVEN, EE_ACTION), BadMessage, "is 7 numbers"),
        (lambda: bridge.chunk(row + np.nan, GIVEN, EE_ACTION), BadMessage, "are finite"),
        (lambda: bridge.chunk(None, GIVEN, EE_ACTION), BadMessage, "has nothing where"),
        (lambda: bridge.chunk(row[:0], GIVEN, EE_ACTION), BadMessage, "finite numbers"),
        (lambda: MAPS["ours"].observation({}, ["front"]), BadMessage, "has nothing where a pic"),
        (lambda: load_map("liberoo"), UnknownName, "known: libero"),
        (lambda: load_map(str(tmp_path / "no.json")), BadPolicy, "cannot be read"),
        (lambda: written("{"), BadPolicy, "Invalid JSON"),
        (lambda: written(good.replace("all", "none")), BadPolicy, "'none' is no part"),
        (lambda: written(good.replace('"execute":4', '"execute":0')), BadPolicy, "execute"),
        (lambda: written(good.replace('"about"', '"abuot"')), BadPolicy, "abuot"),
        (lambda: parse_address("ws://"), BadPolicy, "is no address"),
        (lambda: parse_address("ws://a:1?map=x"), UnknownName, "wire map"),
        (lambda: parse_address("ws://a:1?wire=x"), UnknownName, "wire 'x'"),
        (lambda: parse_address("ws://a:1?mop=x"), UnknownName, "option 'mop'"),
        (lambda: parse_address("ws://me:secret@a:1"), BadPolicy, "is no address"),
    ]:
        refuse(call, error, words)


def test_an_address_says_the_wire_and_the_map() -> None:
    address = parse_address("ws://gpu:8000?map=bridge")
    assert (address.url, address.wire.name) == ("ws://gpu:8000", "vla-eval")
    assert address.label == f"vla-eval:gpu:8000@{MAPS['bridge'].digest}"
    assert parse_address("ws://gpu:8000?wire=vla-eval").map == MAPS["ours-vla-eval"]
    assert replace(address, map=MAPS["ours"]).label != address.label


def test_every_line_of_a_map_is_said() -> None:
    lines = MAPS["libero"].lines()
    assert lines[0] == "observation/image <- camera 0, 224 x 224"
    assert lines[-1].endswith("delta-position*0.05, delta-axis-angle*0.5, closing-sign; 5 a call")
    assert pack({"a": np.float32(1)}, str) == msgpack.packb({"a": 1.0})

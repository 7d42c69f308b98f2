"""Policy files and checkpoints that are damaged, or made to harm: one line each, and none is loaded first and looked at later."""

from __future__ import annotations

import io
import json
import os
import random
import resource
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.errors import CorruptFile, HandoverError
from marl_handover.files import package_path, read_arrays
from marl_handover.learning.checkpoint import FILE, load_checkpoint
from marl_handover.policies.files import LIMIT_BYTES

GOOD = package_path("pretrained/b.npz")
STORED_RUN = Path(__file__).parents[1] / "data" / "run_0_1"


def stored(path, arrays=None, good=GOOD, **about):
    """The shipped policy with other arrays, and saying other things of itself."""
    own = read_arrays(good, LIMIT_BYTES, "policy")
    said = {**json.loads(str(own["about"])), **about}
    np.savez(path, **{**own, **(arrays or {}), "about": np.array(json.dumps(said))})
    return str(path)


def weight(change):
    return {"weight_1": change(read_arrays(GOOD, LIMIT_BYTES, "policy")["weight_1"].copy())}


def with_one(value):
    def change(array):
        array[3, 5] = value
        return array

    return weight(change)


NO_SUM = np.float32([[3e38], [0], [-3e38], [0]])

BAD_ARRAYS = {
    "nan": with_one(np.nan),
    "infinite": with_one(np.inf),
    "complex": weight(lambda array: array + 1j),
    "whole numbers": weight(lambda array: array.astype(np.int64)),
    "text": weight(lambda array: array.astype("U20")),
    "one number": weight(lambda array: array[0, 0]),
    "a row": weight(lambda array: array[0]),
    "a cube": weight(lambda array: array[None]),
    "wide": weight(lambda array: np.hstack([array, array])),
    "narrow": weight(lambda array: array[:, :5]),
    "no bias": {"bias_1": np.zeros((128, 1), np.float32)},
    "other inputs": {"weight_0": np.zeros((7, 128), np.float32)},
    "too few outputs": {"weight_2": np.zeros((128, 2), np.float32), "bias_2": np.zeros(2, np.float32)},
    "no answers": {"weight_1": np.tile(np.float32([3e38, -3e38]), (128, 64)), "weight_2": np.tile(NO_SUM, (32, 6))},
}
BAD_WORDS = {
    "layout": {"layout": "raw"},
    "variant": {"variant": "centralised"},
    "kind": {"kind": "turns"},
    "another kind": {"kind": "box"},
    "modes": {"modes": 40},
    "many modes": {"modes": 10**12},
    "modes is text": {"modes": "1"},
    "endless harmonics": {"harmonics": 10**9},
    "endless layers": {"layers": 10**12},
    "no layers": {"layers": 0},
    "many networks": {"networks": 10**12},
    "cell": {"cell": {"name": "paper"}},
    "task": {"task": 3},
    "no task": {"task": {"epsilon_deg": float("nan")}},
}


def assert_one_line(name, match=None):
    with pytest.raises(HandoverError, match=match) as refused:
        policies.load(str(name))
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400, refused.value
    return str(refused.value)


@pytest.mark.parametrize("name", BAD_ARRAYS)
def test_weights_that_are_no_weights_are_refused(tmp_path, name):
    assert str(tmp_path) in assert_one_line(stored(tmp_path / "bad.npz", BAD_ARRAYS[name]))


@pytest.mark.parametrize("name", BAD_WORDS)
def test_a_policy_that_says_the_wrong_thing_of_itself_is_refused(tmp_path, name):
    assert_one_line(stored(tmp_path / "bad.npz", **BAD_WORDS[name]))


GRAPH = package_path("pretrained/any.npz")


def graph_arrays():
    return {name: array for name, array in read_arrays(GRAPH, LIMIT_BYTES, "policy").items() if name != "about"}


def of_shape(**lie):
    """The shape that the shipped policy for any cell says, changed."""
    return {"shape": {**json.loads(str(read_arrays(GRAPH, LIMIT_BYTES, "policy")["about"]))["shape"], **lie}}


BAD_SHAPES = {
    "wider": of_shape(width=128),
    "narrower": of_shape(width=16),
    "not of sixteens": of_shape(width=60),
    "endless width": of_shape(width=10**12),
    "width is text": of_shape(width="64"),
    "width is true": of_shape(width=True),
    "fewer components": of_shape(components=1),
    "endless components": of_shape(components=10**12),
    "endless rounds": of_shape(rounds=10**12),
    "less than no rounds": of_shape(rounds=-1),
    "rounds are no number": of_shape(rounds=float("nan")),
    "slack is a number": of_shape(slack=1),
    "more than a shape has": of_shape(depth=3),
    "no shape": {"shape": None},
    "a list": {"shape": [64, 6, 2, True]},
    "layers are missing": {"layers": 3},
    "one too many": {"layers": 100},
    "kind": {"kind": "hybrid"},
    "discrete": {"kind": "discrete"},
    "layout": {"layout": "pixels"},
    "variant": {"variant": "decentralised"},
}
BAD_LAYERS = {
    "nan": lambda array: array * np.nan,
    "infinite": lambda array: array + np.inf,
    "complex": lambda array: array + 1j,
    "whole numbers": lambda array: array.astype(np.int64),
    "text": lambda array: array.astype("U20"),
    "one number": lambda array: array.reshape(-1)[0],
    "turned over": lambda array: array.T if array.ndim == 2 and len(array) != array.shape[1] else array[:-1],
    "one row less": lambda array: array[1:],
    "one column more": lambda array: np.concatenate([array, array[..., -1:]], -1),
    "a cube": lambda array: array[None],
    "empty": lambda array: array[:0],
}


@pytest.mark.parametrize("name", BAD_SHAPES)
def test_a_policy_for_any_cell_whose_shape_is_a_lie_is_refused(tmp_path, name):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert str(tmp_path) in assert_one_line(stored(tmp_path / "bad.npz", good=GRAPH, **BAD_SHAPES[name]))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize("name", BAD_LAYERS)
def test_a_policy_for_any_cell_whose_layers_do_not_fit_is_refused(tmp_path, name):
    arrays = graph_arrays()
    for layer in ("weight_0", "bias_0", "weight_5", "bias_9", f"weight_{len(arrays) // 2 - 1}"):
        assert str(tmp_path) in assert_one_line(stored(tmp_path / "bad.npz", {layer: BAD_LAYERS[name](arrays[layer])}, GRAPH))


@pytest.mark.parametrize("missing", ["weight_0", "bias_4", "about"])
def test_a_policy_for_any_cell_that_lacks_something_is_refused(tmp_path, missing):
    arrays = read_arrays(GRAPH, LIMIT_BYTES, "policy")
    np.savez(tmp_path / "bad.npz", **{name: array for name, array in arrays.items() if name != missing})
    assert_one_line(tmp_path / "bad.npz", "policy")


def test_weights_of_a_pair_are_none_for_any_cell_nor_the_other_way_round(tmp_path):
    assert_one_line(stored(tmp_path / "a.npz", kind="graph", layout="graph"))
    assert_one_line(stored(tmp_path / "b.npz", good=GRAPH, kind="hybrid", layout="relative"))


def test_a_policy_for_any_cell_that_overflows_is_refused(tmp_path):
    arrays = {name: np.full_like(array, 1e30) for name, array in graph_arrays().items()}
    assert "fit together" in assert_one_line(stored(tmp_path / "bad.npz", arrays, GRAPH))


@pytest.mark.parametrize("value", [None, [], "text", 3, [[]]])
def test_what_is_no_description_is_refused(tmp_path, value):
    np.savez(tmp_path / "bad.npz", **{**read_arrays(GOOD, LIMIT_BYTES, "policy"), "about": np.array(json.dumps(value))})
    assert_one_line(tmp_path / "bad.npz", "policy")


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "fifo.npz")
    assert "FIFO" in assert_one_line(tmp_path / "fifo.npz")
    os.mkfifo(tmp_path / FILE)
    assert "FIFO" in assert_one_line(tmp_path)


def packed_array(path, shape):
    """A small file of an array that says it has this shape."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("about.npy", "w") as stream:
        stream.write(header.getvalue())
        for _ in range(200):
            stream.write(bytes(1_000_000))


@pytest.mark.parametrize(("shape", "word"), [((50_000_000,), "unpacks to"), ((10**13,), "damaged|unpacks")])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, shape, word):
    packed_array(tmp_path / "bomb.npz", shape)
    assert (tmp_path / "bomb.npz").stat().st_size < 1_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert_one_line(tmp_path / "bomb.npz", word)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_packed_checkpoint_is_refused_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(STORED_RUN / FILE) as old, zipfile.ZipFile(tmp_path / FILE, "w", zipfile.ZIP_DEFLATED) as new:
        for part in old.namelist():
            new.writestr(part, old.read(part))
    assert_one_line(tmp_path, "checkpoint")


def test_a_repeated_number_is_no_tensor_of_a_checkpoint(tmp_path):
    state = torch.load(STORED_RUN / FILE, weights_only=True)
    state["replay"]["rows"] = {"action": torch.zeros(1).expand(10**12)}
    torch.save(state, tmp_path / FILE)
    assert_one_line(tmp_path, "checkpoint")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_run_whose_actor_is_no_numbers_is_refused(tmp_path, value):
    state = torch.load(STORED_RUN / FILE, weights_only=True)
    next(iter(state["best"]["actor"].values())).view(-1)[0] = value
    torch.save(state, tmp_path / FILE)
    assert_one_line(tmp_path, "policy of the run .* not real and finite")


@pytest.mark.parametrize("part", ["best", "algorithm", "counters", "config", "replay", "experience", "random"])
@pytest.mark.parametrize("value", [None, {"actor": {}}])
def test_parts_that_do_not_fit_are_refused(tmp_path, part, value):
    from marl_handover.commands.train import resumed

    state = torch.load(STORED_RUN / FILE, weights_only=True)
    state[part] = value
    torch.save(state, tmp_path / FILE)
    with pytest.raises(HandoverError) as refused:
        resumed(tmp_path)
    assert "\n" not in str(refused.value)


def same(one, other):
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        equal = isinstance(other, torch.Tensor) and one.dtype == other.dtype and one.shape == other.shape
        return equal and bool(torch.equal(one.nan_to_num(), other.nan_to_num()))
    return one == other or (one != one and other != other)


def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path):
    """In the numbers, which have checksums, and in the directory of the file, which has none."""
    whole, draw = (STORED_RUN / FILE).read_bytes(), random.Random(3)
    before = load_checkpoint(STORED_RUN)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        directory, parts = archive.start_dir, archive.infolist()
        entry = directory + whole[directory:].index(parts[-1].filename.encode()) - 46
    places = [8 * (entry + byte) + bit for byte in range(38, 42) for bit in range(8)]  # what kind of entry it is
    places += [draw.randrange(directory * 8) for _ in range(40)] + [draw.randrange(directory * 8, len(whole) * 8) for _ in range(40)]
    refused = 0
    for place in places:
        changed = bytearray(whole)
        changed[place // 8] ^= 1 << place % 8
        (tmp_path / FILE).write_bytes(changed)
        try:
            assert same(before, load_checkpoint(tmp_path)), place
        except CorruptFile:
            refused += 1
    assert refused > 40

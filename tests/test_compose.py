"""The settings front end, on toy dataclasses and YAML files in a temporary folder."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.compose import compose, from_yaml, to_yaml
from marl_handover.config import CellConfig, TaskConfig
from marl_handover.errors import BadOverride, CorruptFile, MissingFile, UnknownChoice, UnknownKey
from marl_handover.schema import keys_help


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


@dataclass
class Algorithm:
    name: str = "???"
    gamma: float = 0.99  # discount


@dataclass
class Sac(Algorithm):
    name: str = "sac"
    alpha: float = 0.2


@dataclass
class Td3(Algorithm):
    name: str = "td3"
    delay: int = 2  # critic steps for each actor step
    sizes: list[int] = field(default_factory=lambda: [256, 256])


@dataclass
class Toy:
    seed: int = 0
    policy: str = "exact"
    storage: str | None = None
    out: Path = Path("runs")
    start: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    colour: Colour = Colour.RED
    amount: int | str = 1
    flag: bool = False
    cell: CellConfig = field(default_factory=CellConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    algorithm: Algorithm = field(default_factory=Sac)


GROUPS = {"algorithm": {"sac": Sac, "td3": Td3}}
ALIASES = {"epsilon_deg": "task.epsilon_deg", "reward": "task.reward"}
PRINTED = st.characters(exclude_categories=["Cc", "Cs"])
"""What text settings may hold: no control characters."""


@pytest.fixture
def configs(tmp_path):
    files = {
        "cell/al5a.yaml": "base_distance_mm: 300\nblock:\n  side_mm: 30\njoint_limits_deg:\n  elbow: [-10, 20]\n  a.b: [0, 1]\n",
        "cell/other.yaml": "name: mine\npick_height_mm: 1\n",
        "preset/paper_b.yaml": "# @package _global_\nseed: 5\ntask:\n  epsilon_deg: 2\n  max_steps: 9\n",
        "preset/fast.yaml": "cell: al5a\nalgorithm:\n  name: td3\n  gamma: 0.9\n  delay: 4\n",
        "preset/both.yaml": "defaults:\n  - override /cell: al5a\n  - algorithm: td3\ncell:\n  base_distance_mm: 310\n",
        "preset/generic.yaml": "algorithm:\n  gamma: 0.5\n",
        "preset/wrong.yaml": "task:\n  epsilon: 2\n",
    }
    for name, text in files.items():
        path = tmp_path / "configs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "configs"


@pytest.fixture
def make(configs):
    def make(*overrides):
        return compose(Toy, overrides, GROUPS, ALIASES, configs)

    return make


def test_no_overrides_give_the_defaults(make):
    assert make() == Toy()


def test_nested_and_typed_values(make):
    toy = make("task.epsilon_deg=3", "task.reward.step=-2", "start=[0,150,30]", "colour=BLUE", "flag=true", "seed=1e3", "out=a/b=c")
    assert (toy.task.epsilon_deg, toy.task.reward.step, toy.start) == (3.0, -2.0, [0.0, 150.0, 30.0])
    assert isinstance(toy.task.epsilon_deg, float)
    assert (toy.colour, toy.flag, toy.seed, toy.out) == (Colour.BLUE, True, 1000, Path("a/b=c"))


@pytest.mark.parametrize(
    "text", ["sqlite:///x?y=z", "runs/lr=3e-4", "a,b", "1e3", "007", "true", "runs/ä (1)", "C:\\x", "#1", "[1", "a: b", "{x", "it's"]
)
def test_text_settings_are_literal(make, text):
    assert make(f"policy={text}", f"storage={text}") == Toy(policy=text, storage=text)


def test_quotes_and_null(make):
    assert make("policy='a=b'", 'storage="x, y"') == Toy(policy="a=b", storage="x, y")
    assert make("storage=x", "storage=null").storage is None
    assert make("policy=null").policy == "null"
    assert (make("amount=3").amount, make("amount=a=b").amount) == (3, "a=b")


def test_dictionaries(make):
    limits = CellConfig().joint_limits_deg
    assert make("cell.joint_limits_deg.elbow=[0,90]").cell.joint_limits_deg == limits | {"elbow": [0.0, 90.0]}
    both = make("cell.joint_limits_deg={elbow:[0,90],wrist:[1,2]}").cell.joint_limits_deg
    assert both == limits | {"elbow": [0.0, 90.0], "wrist": [1.0, 2.0]}
    assert make("task.reward={success:10,step:-3}").task.reward.success == 10.0
    assert make("+cell.joint_limits_deg.elbow=[0,9]").cell.joint_limits_deg["elbow"] == [0.0, 9.0]


def test_shorthands(make):
    assert make("epsilon_deg=1").task.epsilon_deg == 1.0
    assert make("reward.success=7").task.reward.success == 7.0


def test_yaml_options(make, tmp_path, monkeypatch):
    toy = make("cell=al5a")
    assert (toy.cell.base_distance_mm, toy.cell.block.side_mm, toy.cell.name) == (300.0, 30.0, "al5a")
    assert toy.cell.joint_limits_deg == CellConfig().joint_limits_deg | {"elbow": [-10.0, 20.0], "a.b": [0.0, 1.0]}
    assert make("cell=other").cell.name == "mine"
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / "own.yaml").write_text("base_distance_mm: 333\n")
    (tmp_path / "x.yaml").write_text("cell: my/own.yaml\n")
    monkeypatch.chdir(tmp_path)
    assert make("cell=my/own.yaml").cell == CellConfig(name="own", base_distance_mm=333.0)
    monkeypatch.chdir(tmp_path / "my")
    assert make("preset=../x.yaml").cell.base_distance_mm == 333.0  # a path in a file counts from that file


def test_code_options(make):
    assert make("algorithm=td3").algorithm == Td3()
    assert make("algorithm.delay=3", "algorithm=td3", "algorithm.sizes=[8]").algorithm == Td3(delay=3, sizes=[8])
    assert make("algorithm.name=td3").algorithm == Td3()
    assert make("algorithm={name:td3,delay:7}").algorithm == Td3(delay=7)


def test_presets(make):
    assert make("preset=paper_b").task.max_steps == 9
    assert make("preset=fast").algorithm == Td3(gamma=0.9, delay=4)
    assert make("preset=fast").cell.name == "al5a"
    both = make("preset=both")
    assert (both.cell.base_distance_mm, both.cell.block.side_mm, both.algorithm) == (310.0, 30.0, Td3())


@pytest.mark.parametrize("backwards", [False, True])
def test_precedence_does_not_depend_on_the_order_typed(make, backwards):
    def ordered(*overrides):
        return make(*(overrides[::-1] if backwards else overrides))

    assert ordered("preset=paper_b", "epsilon_deg=3").task.epsilon_deg == 3.0
    assert ordered("cell=al5a", "cell.base_distance_mm=250").cell.base_distance_mm == 250.0
    assert ordered("preset=both", "cell=al5a").cell.base_distance_mm == 310.0
    assert ordered("preset=generic", "algorithm=td3").algorithm == Td3(gamma=0.5)
    assert ordered("preset=both", "cell=other").cell.base_distance_mm is None  # the preset's differences were for al5a
    assert ordered("preset=fast", "algorithm=sac", "algorithm.alpha=1").algorithm == Sac(alpha=1.0)


def test_the_last_of_equal_keys_counts(make):
    assert make("seed=1", "seed=2").seed == 2
    assert make("algorithm=td3", "algorithm=sac").algorithm == Sac()


def test_unknown_keys(make):
    with pytest.raises(UnknownKey, match=r"'task\.epsilon'.*valid keys: epsilon_deg,") as caught:
        make("task.epsilon=1")
    assert set(caught.value.choices) == set(TaskConfig.__dataclass_fields__)
    with pytest.raises(UnknownKey, match=r"valid keys: task\.max_steps, ") as caught:
        make("max_steps=1")
    assert {"seed", "epsilon_deg", "preset"} <= set(caught.value.choices)
    with pytest.raises(UnknownKey, match=r"'algorithm\.delay'"):
        make("algorithm.delay=1")  # a key of td3, and sac is chosen
    with pytest.raises(UnknownKey, match=r"task.epsilon in .*wrong\.yaml"):
        make("preset=wrong")
    with pytest.raises(UnknownKey, match=r"'task\.reward\.x'"):
        make("task.reward={x:1}")


@pytest.mark.parametrize(
    "text",
    [
        "task.epsilon_deg=abc",
        "seed=1.5",
        "seed=x",
        "flag=2",
        "start=[0,a]",
        "start=3",
        "seed=null",
        "colour=GREEN",
        "task.epsilon_deg=true",
    ],
)
def test_wrong_types(make, text):
    with pytest.raises(BadOverride) as caught:
        make(text)
    assert caught.value.text == text
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "seed",
        "=3",
        "",
        "start=[0,1",
        "seed=1,2",
        "seed=choice(1,2)",
        "policy='x",
        "~seed",
        "cell@x=1",
        "--seed=1",
        "a b=1",
        "task=3",
        "seed.x=1",
        "start.0=1",
        "task={a",
        "task.epsilon_deg=${nowhere}",
        "start=${oc.env:PWD}",
        "start=[0,1,${oc.env:PWD}]",
        "start=${start}",
        "algorithm.name.x=1",
        "task=foo",
        "cell=null",
        "seed=${",
        ".seed=1",
    ],
)
def test_malformed_overrides(make, text):
    with pytest.raises(BadOverride) as caught:
        make(text)
    assert "\n" not in str(caught.value)


def test_a_reference_takes_the_value_that_its_key_has_in_the_end(make):
    config = make("task.epsilon_deg=${seed}", "start=[${seed},0,1]", "seed=7")
    assert (config.task.epsilon_deg, list(config.start), config.seed) == (7.0, [7.0, 0.0, 1.0], 7)


def test_unknown_options(make):
    with pytest.raises(UnknownChoice, match="sac, td3"):
        make("algorithm=ppo")
    with pytest.raises(UnknownChoice, match="al5a, other"):
        make("cell=al5")
    with pytest.raises(UnknownChoice, match="paper_b"):
        make("preset=paper_a")


def test_bad_files(make, tmp_path, configs):
    with pytest.raises(MissingFile, match=r"nowhere\.yaml"):
        make(f"cell={tmp_path}/nowhere.yaml")
    for name, text in {
        "a": "x: [1",
        "b": "- 1\n- 2\n",
        "c": "!!python/object/apply:os.getcwd []",
        "d": "a: 1\na: 2\n",
        "e": "just text",
    }.items():
        (tmp_path / f"{name}.yaml").write_text(text)
        with pytest.raises(CorruptFile) as caught:
            make(f"preset={tmp_path}/{name}.yaml")
        assert "\n" not in str(caught.value)
    (tmp_path / "f.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(CorruptFile):
        make(f"cell={tmp_path}/f.yaml")
    (configs / "preset" / "nested.yaml").write_text("preset: fast\n")
    with pytest.raises(BadOverride, match="cannot name another preset"):
        make("preset=nested")
    (configs / "preset" / "typo.yaml").write_text("seed: abc\n")
    with pytest.raises(BadOverride, match=r"seed=abc in .*typo\.yaml"):
        make("preset=typo")
    (configs / "preset" / "empty.yaml").write_text("")
    assert make("preset=empty") == Toy()


def test_an_option_must_carry_its_name():
    with pytest.raises(TypeError, match="name: str = 'ddpg'"):
        compose(Toy, ["algorithm=ddpg"], {"algorithm": {"ddpg": Sac}})


def test_round_trip(make, tmp_path):
    path = tmp_path / "config.yaml"
    for toy in (make(), make("preset=fast", "storage=sqlite:///x?y=z", "colour=BLUE", "out=x/y", "start=[1,2,3]", "amount=b")):
        path.write_text(to_yaml(toy))
        assert from_yaml(Toy, path, GROUPS) == toy


@settings(max_examples=50)
@given(
    policy=st.text(PRINTED, max_size=100),
    seed=st.integers(-(2**60), 2**60),
    start=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=3),
)
def test_round_trip_of_any_value(tmp_path_factory, policy, seed, start):
    toy = Toy(policy=policy, seed=seed, start=start, algorithm=Td3())
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(to_yaml(toy), encoding="utf-8", newline="")
    assert from_yaml(Toy, path, GROUPS) == toy


def test_a_stored_configuration_that_does_not_fit(tmp_path):
    path = tmp_path / "config.yaml"
    with pytest.raises(MissingFile):
        from_yaml(Toy, path)
    for text in ("sed: 1\n", "seed: x\n", "algorithm:\n  name: ppo\n"):
        path.write_text(text)
        with pytest.raises(CorruptFile, match=r"config\.yaml"):
            from_yaml(Toy, path, GROUPS)
    path.write_text("seed: 3\n")
    assert from_yaml(Toy, path, GROUPS) == Toy(seed=3)


def test_nothing_global_is_left_behind(make, tmp_path, monkeypatch):
    from hydra.core.config_store import ConfigStore
    from hydra.core.global_hydra import GlobalHydra

    monkeypatch.chdir(tmp_path)
    before, stored = set(tmp_path.rglob("*")), dict(ConfigStore.instance().repo)
    make("cell=al5a", "preset=fast", "seed=3")
    assert not GlobalHydra.instance().is_initialized()
    assert ConfigStore.instance().repo == stored
    assert set(tmp_path.rglob("*")) == before


def test_keys_help(configs):
    text = keys_help(Toy, ALIASES, GROUPS, configs)
    lines = {line.split()[0]: line for line in text.splitlines()}
    assert "epsilon_deg = task.epsilon_deg" in text
    assert "allowed orientation error" in text
    assert "sac | td3" in lines["algorithm"]
    assert "[td3] critic steps for each actor step" in lines["algorithm.delay"]
    assert "al5a | other | FILE.yaml" in lines["cell"]
    assert "paper_b" in lines["preset"]
    assert lines["storage"].split() == ["storage", "str", "|", "None", "null"]
    assert {"seed", "cell.block.side_mm"} <= set(lines)

"""Whatever is written on a command line is taken, or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import synthetic
from plab.cli.run import main
from plab.config import GROUPS, Config, choices, load_config
from plab.config.checks import check_sources
from plab.config.selection import select
from plab.errors import PlabError
from plab.report.collect import collect
from plab.status import NAMES, survey

FEW, MANY = 200, 2000
"""Cases that are tried each time, and in the slow tests."""

cases = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.nightly)])


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


# ------------------------------------------------------------------------------------------------ grammar


def _leaves(node: Any, path: str) -> Iterator[str]:
    """Dotted keys of a configuration, sections included."""
    for name, value in node.items():
        yield f"{path}{name}"
        if isinstance(value, dict):
            yield from _leaves(value, f"{path}{name}.")


def _keys() -> list[str]:
    """Keys of all kinds of methods and of some tasks, and what looks like one."""
    methods = "adam", "sac", "td3", "ppo", "cem", "solve", "apg", "pods", "shac"
    composed = [load_config([f"method={one}"]) for one in methods]
    composed += [load_config([f"task={one}", "variant=3"]) for one in ("Move", "Torus")]
    known = dict.fromkeys(key for cfg in composed for key in _leaves(asdict(cfg), ""))
    groups = [
        *GROUPS,
        "experiment",
        "hydra/launcher",
        "hydra/sweeper",
        "task@other",
        "schema/method",
        "method@_here_",
    ]
    hydra = [
        *("hydra", "hydra.run.dir", "hydra.mode", "hydra.job", "hydra.sweep.dir", "hydra.launcher"),
        *("hydra.launcher.batch_size", "hydra.launcher.inner", "hydra.launcher._target_"),
        *("hydra.sweeper", "hydra.sweeper.max_batch_size", "hydra.sweeper.params", "hydra.searchpath"),
    ]
    unknown = [
        "tsk",
        "sim.precison",
        "method.nope",
        "task.bodies",
        "task.bodies.new",
        "a.b.c",
        "",
        ".",
        "seed.x",
    ]
    random = ["task.random.shift.low", "task.random.variant", "task.variants.3", "task.release.yield_stress"]
    return [*known, *groups, *hydra, *unknown, *random]


KEYS = _keys()

NUMBERS = [
    *("0", "1", "-1", "3", "7", "0.5", "-0.0", "1e-300", "1e-320", "1e-9", "1e9", "1e30", "1e300", "1e400"),
    *(
        "nan",
        "inf",
        "-inf",
        ".inf",
        "1_000",
        "007",
        "0x10",
        "1e",
        "9" * 20,
        "-" + "9" * 20,
        "9" * 400,
        "9" * 5000,
    ),
]
TEXTS = [
    *(
        "",
        "''",
        '""',
        "' '",
        "null",
        "None",
        "true",
        "false",
        "???",
        "x",
        "adam",
        "Rope",
        "random",
        "a b",
        "a=b",
        "#",
    ),
    *(
        "größe",
        "日本",
        "it's",
        "'it",
        '"',
        "\\",
        "a\\'b",
        "a:b",
        "module:NAME",
        "os:path",
        "plab.families:FAMILIES",
    ),
    *(
        "${seed}",
        "${nothing}",
        "${oc.env:PLAB_NO_SUCH}",
        "${",
        "$",
        "{}",
        "[]",
        "[",
        "}",
        "{a:1}",
        "{a:{b:c}}",
        ",",
    ),
    *(
        ".",
        "-",
        "--help",
        "%",
        "\t",
        "a\nb",
        "\x00",
        "[" * 50,
        "[" * 2000,
        "a" * 3000,
    ),
]
SWEEPS = [
    *("1,2", "a,b", "range(3)", "range(0)", "range(1e9)", "range(0,1,0)", "range(0,1,0.25)", "range(nan)"),
    *("range(0,1e-300,1e-309)", "glob(*)", "glob(Z*)", "glob([*],exclude=[*])", "choice(1,2)", "choice()"),
    *(
        "interval(0,1)",
        "shuffle(range(1000000000))",
        "sort(3,1,2)",
        "int(1.5)",
        "str([1])",
        "extend_list(1)",
        "tag(a,1)",
    ),
    *("range(1,100000000000000000000)", "float(range(1000000000))", "nosuch(1)"),
]

values = st.one_of(
    st.sampled_from(NUMBERS + TEXTS + SWEEPS),
    st.sampled_from([name for group in GROUPS for name in choices(group)]),
    st.lists(st.sampled_from(NUMBERS + TEXTS), min_size=1, max_size=4).map(
        lambda many: f"[{','.join(many)}]"
    ),
    st.tuples(st.sampled_from(KEYS), st.sampled_from(NUMBERS + TEXTS)).map(
        lambda one: f"{{{one[0]}:{one[1]}}}"
    ),
    st.integers().map(str),
    st.floats().map(str),
    st.text(max_size=6),
)
overrides = st.one_of(
    st.builds(
        lambda sign, key, value: f"{sign}{key}={value}",
        st.sampled_from(["", "", "", "", "+", "++", "~"]),
        st.sampled_from(KEYS),
        values,
    ),
    st.sampled_from(KEYS).map(lambda key: f"~{key}"),
    st.text(max_size=12),
)
choosing = st.one_of(
    *(st.sampled_from(list(choices(group))).map(f"{group}={{}}".format) for group in GROUPS),
    st.sampled_from(["variant=random", "variant=2", "+experiment=smoke", "seed=1"]),
)
commands = st.lists(st.one_of(overrides, overrides, choosing), min_size=1, max_size=3)


def trying(count: int) -> settings:
    """Settings for so many cases, the same each time."""
    unhealthy = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
    return settings(
        max_examples=count, deadline=None, derandomize=True, database=None, suppress_health_check=unhealthy
    )


def assert_helpful(error: PlabError) -> None:
    """Assert that an answer is one line of words."""
    line = str(error)
    assert len(line) > 15 and "Traceback" not in line
    assert len(" ".join(line.split())) < 2000


# ------------------------------------------------------------------------------------------------ overrides


@pytest.mark.parametrize(
    "word",
    [
        f"task=[#,{'[' * 2000}]",
        f"task={'a' * 3000}",
        f"variant={'a' * 3000}",
        f"task.bodies.rope={'a' * 3000}",
        f"method.contact={'a ' * 1500}",
    ],
    ids=lambda word: word[:20],
)
def test_long_values_are_cut_short(word: str) -> None:
    with pytest.raises(PlabError) as caught:
        load_config([word])
    assert_helpful(caught.value)


def test_what_stands_between_quoted_words_is_not_cut() -> None:
    names = ", ".join(f"name{k}" for k in range(100))
    message = f"'a' does not exist; choose from: {names}; or leave 'b' out"
    assert str(PlabError(message)) == message


@cases
def test_any_overrides(count: int) -> None:
    @trying(count)
    @given(commands)
    def attempt(words: list[str]) -> None:
        try:
            cfg = load_config(words)
            check_sources(cfg)
        except PlabError as error:
            assert_helpful(error)
        else:
            assert isinstance(cfg, Config)

    attempt()


@cases
def test_any_command_line_of_a_sweep(
    count: int, seen: list[Config], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Nothing is to be written to folders that chance names.
    monkeypatch.setattr("plab.results.files.make_folder", lambda folder: [])

    @trying(count // 4)
    @given(commands)
    def attempt(words: list[str]) -> None:
        seen.clear()
        capsys.readouterr()
        # What looks like a flag is one.
        code = main(["-m", "progress=false", *(word for word in words if not word.startswith("-"))])
        _, err = capsys.readouterr()
        assert code in (0, 2), err
        assert code == 2 or seen
        assert (code == 2) == bool(err)
        assert all(line.startswith("plab: ") for line in err.splitlines()), err

    attempt()


# ------------------------------------------------------------------------------------------------ selections


@cases
def test_any_words_of_a_selection(count: int, tmp_path) -> None:
    synthetic.save(synthetic.run(tmp_path / "results"))
    chosen = st.builds("{}={}".format, st.sampled_from([*NAMES, *NAMES, *KEYS]), values)

    @trying(count // 4)
    @given(st.lists(st.one_of(chosen, choosing, overrides), min_size=1, max_size=2))
    def attempt(words: list[str]) -> None:
        try:
            wanted = select(words, NAMES)
            survey("results", wanted)
            collect("results", wanted)
        except PlabError as error:
            assert_helpful(error)

    attempt()

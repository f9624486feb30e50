"""Submissions: what is written is read, what is broken is refused in one line, what the page shows."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import plab
import synthetic
from browsing import browsing, press
from plab.bench.results import synthetic_run, template
from plab.cli import leaderboard, submit, verify
from plab.config import load_config
from plab.config.suite import suite_tasks
from plab.report.reference import paper_table
from plab.submissions.board import board
from plab.submissions.files import encode, read, read_members, write
from plab.submissions.schema import (
    UNSEEN,
    Card,
    CardError,
    Configuration,
    Digests,
    Entry,
    Submission,
    SubmissionError,
    configuration_of,
    parse_card,
)
from plab.submissions.verifying import (
    HOLDS,
    LIES,
    NOT_RUN,
    TOLERANCE,
    Verdict,
    Verification,
    read_verification,
    write_verification,
)

ROOT = Path(__file__).resolve().parents[1]
CARD = Card("Mine", ("A. Author", "B. Author"), "https://example.org/mine", 10**9, "a laptop", False)
DIGESTS = Digests("a" * 64, "b" * 64)
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))


def entry(variant: str = "1", steps: int = 100, score: float = 0.5, **which: Any) -> Entry:
    given = {"digests": DIGESTS, "actions": ACTIONS} | which
    return Entry(Configuration("Move", variant), steps=steps, score=score, **given)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A submission of two plans."""
    made = tmp_path / "mine.plabsub.zip"
    write(Submission(CARD, (entry(), entry("2", steps=5000))), made)
    return made


def changed(path: Path, **members: bytes | None) -> Path:
    """Put other members into a file, by their names with ``_`` for every other sign; None takes one out."""
    kept = read_members(path)
    names = {re.sub(r"\W", "_", name): name for name in kept}
    for key, content in members.items():
        if content is None:
            del kept[names[key]]
        else:
            kept[names[key]] = content
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in kept.items():
            archive.writestr(name, content)
    return path


def with_manifest(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    about = json.loads(read_members(path)["manifest.json"])
    change(about)
    return changed(path, manifest_json=json.dumps(about).encode())


def with_entry(path: Path, **values: Any) -> Path:
    return with_manifest(path, lambda about: about["entries"][1].update(values))


def why(path: Path) -> str:
    """Return what is said of a file, without its name in front."""
    with pytest.raises(SubmissionError) as caught:
        read(path)
    return str(caught.value).removeprefix(f"{path}: ")


# -------------------------------------------------------------------------------------------- round trip


def test_what_is_written_is_read(path: Path) -> None:
    found = read(path)
    assert found.card == CARD and found.plab == plab.__version__ and found.track == "plans"
    assert [(e.configuration.name, e.steps, e.score) for e in found.entries] == [
        ("Move-v1", 100, 0.5),
        ("Move-v2", 5000, 0.5),
    ]
    assert all(np.array_equal(e.actions, ACTIONS) and e.digests == DIGESTS for e in found.entries)


def test_the_same_submission_gives_the_same_bytes(path: Path) -> None:
    assert encode(read(path)) == path.read_bytes()


def test_policies_are_kept_as_they_are(tmp_path: Path) -> None:
    policy, made = {"policies/Move.pt": b"some program"}, tmp_path / "p.plabsub.zip"
    entries = [entry(v, actions=None, policy="policies/Move.pt") for v in ("1", UNSEEN[0])]
    write(Submission(CARD, tuple(entries), policy), made)
    found = read(made)
    assert (found.track, found.policies) == ("policies", policy)
    assert [e.policy for e in found.entries] == ["policies/Move.pt"] * 2


def test_names_end_as_submissions_do(tmp_path: Path) -> None:
    with pytest.raises(SubmissionError) as caught:
        write(Submission(CARD, ()), tmp_path / "mine.zip")
    assert str(caught.value) == f"a submission's name ends in .plabsub.zip: {tmp_path / 'mine.zip'}"


# ------------------------------------------------------------------------------------------------- broken


def test_a_file_that_is_missing_cut_off_or_something_else(path: Path) -> None:
    whole = path.read_bytes()
    for content in (whole[:-30], b"", b"not a zip file at all"):
        path.write_bytes(content)
        assert why(path).startswith(f"{path} is cut off, damaged or no zip file (")
    # Its directory is whole, what it leads to is not.
    path.write_bytes(whole[:200] + bytes(200) + whole[400:])
    assert "cut off, damaged or no zip file" in why(path) or "has a member" in why(path)
    path.unlink()
    assert why(path) == f"{path} does not exist"


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../out", "a/../../b", "a\\b", "C:/x", "a//b", "./a", "a\nb"]
)
def test_names_that_lead_elsewhere(path: Path, name: str) -> None:
    info = zipfile.ZipInfo("x")
    info.filename = name
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(info, b"")
    assert why(path) in (
        f"{path} has a member with the name {name!r}, which is not allowed",
        f"{path} cannot be read: its member {name!r} leads out of the folder",
    )


def test_two_members_of_one_name(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("card.yaml", b"name: other")
    assert why(path) == f"{path} cannot be read: it has two members 'card.yaml'"


def test_links_and_encrypted_members(path: Path) -> None:
    link = zipfile.ZipInfo("link")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(link, b"/etc/passwd")
    assert why(path) == "link is no plain file"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("secret", b"x")
    content = bytearray(path.read_bytes())
    place = content.index(b"PK\x01\x02") + 8
    content[place : place + 2] = struct.pack("<H", 1)
    path.write_bytes(content)
    assert why(path) == f"{path} cannot be read: its member 'secret' is encrypted"


def test_more_than_is_allowed(path: Path) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(5_000_000))
    path.write_bytes(bomb.getvalue())

    def refusal(**limits: int) -> str:
        with pytest.raises(SubmissionError) as caught:
            read_members(path, **({"count": 1, "each": 10**7, "total": 10**7} | limits))
        return str(caught.value).removeprefix(f"{path}")

    assert len(bomb.getvalue()) < 10_000
    assert refusal(each=10**6) == ": unpacked, zeros would take more than the 1 MB allowed"
    assert refusal(total=2 * 10**6) == ": unpacked, it would take more than the 2 MB allowed"
    assert refusal(count=0) == " holds 1 members, more than the 0 allowed"
    assert refusal(total=1000) == " is larger than the 0.001 MB allowed"


def test_a_size_that_is_a_lie_floods_nothing(path: Path) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(5_000_000))
    # Where the directory has the unpacked size.
    content = bytearray(bomb.getvalue())
    place = content.index(b"PK\x01\x02") + 24
    content[place : place + 4] = struct.pack("<I", 10)
    path.write_bytes(content)
    with pytest.raises(SubmissionError) as caught:
        read_members(path, count=10, each=1000, total=100_000)
    assert str(caught.value).startswith(f"{path} is cut off, damaged or no zip file (")


def npy(array: np.ndarray, **options: Any) -> bytes:
    content = io.BytesIO()
    np.save(content, array, **options)
    return content.getvalue()


HUGE = npy(np.zeros((10, 3))).replace(b"(10, 3)", b"(99, 9)")


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"\x93NUMPY\x01\x00rubbish", "actions/0001.npy is no NumPy file"),
        (b"", "actions/0001.npy is no NumPy file"),
        (npy(ACTIONS)[:-8], "actions/0001.npy is cut off"),
        (HUGE, "actions/0001.npy is cut off"),
        (npy(ACTIONS * 3), "actions/0001.npy holds actions outside of [-1, 1]"),
        (npy(ACTIONS * np.nan), "actions/0001.npy holds actions outside of [-1, 1]"),
        (
            npy(np.array([[print]], object), allow_pickle=True),
            "actions/0001.npy must hold float64 numbers of shape [steps, components]",
        ),
        (
            npy(ACTIONS[0]),
            "actions/0001.npy must hold float64 numbers of shape [steps, components]",
        ),
    ],
)
def test_actions_that_are_none(path: Path, content: bytes, line: str) -> None:
    assert why(changed(path, actions_0001_npy=content)) == line


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda about: about.update(format=7), f"it has layout 7, this plab ({plab.__version__}) reads 1"),
        (lambda about: about.pop("format"), "manifest.json has no format"),
        (lambda about: about.update(plab="<script>"), "manifest.json does not say which plab wrote it"),
        (lambda about: about.update(entries=None), "manifest.json has no physics, or no entries"),
        (
            lambda about: about["entries"][0].pop("steps"),
            "entry 0 must have the keys file, scene, score, steps, target, targets, task, terms, variant",
        ),
        (
            lambda about: about["entries"].append(about["entries"][0]),
            "it has two entries for Move-v1 after 100 steps",
        ),
    ],
)
def test_a_manifest_that_does_not_fit(path: Path, change: Callable[[dict], Any], line: str) -> None:
    assert why(with_manifest(path, change)) == line


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"task": "Moove"}, "entry 1 has task 'Moove', which the leaderboard has not"),
        ({"variant": "random7"}, "entry 1 has variant 'random7', which the leaderboard has not"),
        ({"score": 1.5}, "entry 1 has a score that is not in [0, 1]"),
        ({"score": float("nan")}, "entry 1 has a score that is not in [0, 1]"),
        ({"steps": -1}, "entry 1 must say after how many steps it was found"),
        ({"steps": True}, "entry 1 must say after how many steps it was found"),
        ({"scene": "x"}, "entry 1 has a scene that is no SHA-256"),
        ({"file": "actions/9.npy"}, "entry 1 names a file that is not there: 'actions/9.npy'"),
        (
            {"file": "card.yaml"},
            "entry 1 names card.yaml, which is neither actions/*.npy nor policies/*.pt or *.onnx",
        ),
        (
            {"targets": "authors", "variant": UNSEEN[0]},
            f"entry 1: the authors have no targets of {UNSEEN[0]}",
        ),
    ],
)
def test_an_entry_that_does_not_fit(path: Path, values: dict[str, Any], line: str) -> None:
    assert why(with_entry(path, **values)) == line


def test_members_that_nothing_is_said_of(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("setup.py", b"import os")
    assert why(path) == f"{path} holds setup.py, of which its manifest.json says nothing"
    assert why(changed(path, manifest_json=b"{")) == "manifest.json is no JSON"
    assert why(changed(path, manifest_json=None)) == f"{path} is no submission: it has no manifest.json"


def test_a_budget_that_was_passed(tmp_path: Path) -> None:
    made = tmp_path / "x.plabsub.zip"
    card = dataclasses.replace(CARD, budget=5000)
    write(Submission(card, (entry(steps=100), entry(steps=3000), entry("2", steps=2500))), made)
    assert why(made) == "its card has a budget of 5,000 steps, its entries took 5,500"


def test_plans_and_policies_together(tmp_path: Path) -> None:
    made = tmp_path / "x.plabsub.zip"
    both = (entry(), entry("2", actions=None, policy="policies/a.pt"))
    write(Submission(CARD, both, {"policies/a.pt": b""}), made)
    assert why(made) == "it holds plans and policies: submit them apart"


# --------------------------------------------------------------------------------------------------- cards

GOOD = {
    "name": "Mine",
    "authors": ["A. Author", "B. Author"],
    "link": "https://example.org/mine",
    "budget": 10**9,
    "hardware": "a laptop",
    "gradient": False,
}


def test_a_card_is_read() -> None:
    assert parse_card(yaml.safe_dump(GOOD).encode(), "card.yaml") == CARD


def test_every_mistake_of_a_card_has_its_line() -> None:
    card = {
        **GOOD,
        "nam": "x",
        "link": "javascript:alert(1)",
        "budget": "many",
        "gradient": "no",
        "authors": [],
    }
    del card["hardware"]
    with pytest.raises(CardError) as caught:
        parse_card(yaml.safe_dump(card).encode(), "card.yaml")
    names = "name, authors, link, budget, hardware, gradient, description"
    assert caught.value.faults == [
        f"card.yaml: unknown key 'nam'; did you mean name? choose from: {names}",
        "card.yaml: authors must be a list of 1 to 50 names",
        "card.yaml: link must begin with https:// or http://",
        "card.yaml: budget must be a whole number of environment steps",
        "card.yaml: hardware is missing",
        "card.yaml: gradient must be true or false",
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (b"name: [", "card.yaml is no YAML, line 1"),
        (b"\xff\xfe\xfa", "card.yaml is no YAML"),
        (b"!!python/object/apply:os.system ['true']", "card.yaml is no YAML, line 1"),
        (b"[" * 50_000, "card.yaml is no YAML"),
        (b"x" * 70_000, "card.yaml is larger than the 64 kB allowed"),
        (
            b"42",
            "card.yaml must have the keys name, authors, link, budget, hardware, gradient, description",
        ),
    ],
)
def test_a_card_that_is_none(text: bytes, line: str) -> None:
    with pytest.raises(CardError) as caught:
        parse_card(text, "card.yaml")
    assert caught.value.faults == [line]


def test_cards_that_are_shown_are_good() -> None:
    example = (ROOT / "examples" / "outside_agent" / "card.yaml").read_text(encoding="utf-8")
    shown = parse_card(example.encode(), "card.yaml")
    assert (shown.name, shown.hardware) == ("PPO in one file", "two CPU cores")
    assert example in (ROOT / "docs" / "submissions.md").read_text(encoding="utf-8")


# -------------------------------------------------------------------------------------- configurations


def test_configurations_have_their_names() -> None:
    names = {
        "Rope-v3": ["task=Rope", "variant=3"],
        "Move-v1-release": ["task=Move", "protocol=release"],
        f"Move-v{UNSEEN[2]}": ["task=Move", "variant=random", f"seed_scene={UNSEEN[2][6:]}"],
        "Torus-v2-authors-release": ["task=Torus", "variant=2", "protocol=release", "targets.source=there"],
    }
    for name, words in names.items():
        assert configuration_of(load_config(words)).name == name


def test_a_configuration_composes_what_it_was_made_of() -> None:
    for words in (["variant=4"], ["variant=random", "seed_scene=9003"], ["protocol=release"]):
        cfg = load_config(["task=Move", *words])
        assert Digests.of(configuration_of(cfg).config(())) == Digests.of(cfg)


def test_configurations_that_are_none_of_the_leaderboard() -> None:
    with pytest.raises(SubmissionError) as caught:
        configuration_of(load_config(["task=Move", "variant=random", "seed_scene=3"]))
    assert str(caught.value) == (
        "Move-vrandom3 is no configuration of the leaderboard: those are the variants 1 to 5, and "
        "variant=random with seed_scene=9000 to 9009"
    )
    with pytest.raises(SubmissionError) as caught:
        configuration_of(load_config(["task=Move", "protocol.floor=release"]))
    assert str(caught.value) == (
        "start, numbers and floor of the protocol are mixed: submit for protocol=plab or protocol=release"
    )
    with pytest.raises(SubmissionError) as caught:
        Configuration("Move", "1", "authors").config(())
    assert str(caught.value) == (
        "Move-v1-authors needs the authors' target files: add targets.source=<their folder>"
    )


def test_digests_tell_scenes_and_targets_apart() -> None:
    usual = Digests.of(load_config(["task=Move"]))
    assert Digests.of(load_config(["task=Move", "seed=3", "method=gd", "sim.precision=float64"])) == usual
    finer = Digests.of(load_config(["task=Move", "sim.substeps=20"]))
    assert finer.scene != usual.scene and finer.target == usual.target


# ------------------------------------------------------------------------------------------- command lines


@pytest.fixture
def card(tmp_path: Path) -> Path:
    made = tmp_path / "card.yaml"
    made.write_text(yaml.safe_dump(GOOD))
    return made


def result(folder: Path, variant: str = "1", seed: int = 0, method: str = "adam") -> Path:
    config = template(method, [f"results_dir={folder}", "task=Move", f"variant={variant}", f"seed={seed}"])
    return synthetic.save(synthetic_run(config, rows=4, score=0.4))


def test_results_become_a_submission(tmp_path: Path, card: Path, capsys: pytest.CaptureFixture) -> None:
    folder, out = tmp_path / "results", tmp_path / "out.plabsub.zip"
    for variant in "12":
        result(folder, variant)
    result(folder, seed=1)
    assert submit.main([str(folder), "seed=0", "--card", str(card), "--output", str(out)]) == 0
    assert capsys.readouterr().out.startswith(f"{out}: plans for 2 configuration(s), ")
    found = read(out)
    assert [e.configuration.name for e in found.entries] == ["Move-v1", "Move-v2"]
    assert found.entries[0].score == pytest.approx(0.4)
    assert found.entries[0].steps % 50 == 0 and 50 <= found.entries[0].steps <= 200
    assert found.entries[0].digests == Digests.of(load_config(["task=Move"]))


def test_mistakes_of_submit(
    tmp_path: Path, card: Path, told: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # However slow this computer is, the results have changed just now: no database is made of them.
    monkeypatch.setattr("plab.results.store._SETTLED", math.inf)
    folder, out = tmp_path / "results", str(tmp_path / "out.plabsub.zip")
    first, second = result(folder), result(folder, seed=1)
    usual = ["--card", str(card), "--output", out]

    def line(*argv: str) -> str:
        return told([*argv], submit.main).removeprefix("plab: ")

    both = f"{second} and {first} are both of Move-v1: submit one training of each"
    assert line(str(folder), *usual) == both
    nothing = "there is nothing to submit: no episode has ended, or no finished run fits"
    assert line(str(folder), "seed=7", *usual) == nothing
    missing = tmp_path / "no.yaml"
    cannot = f"cannot read {missing}: No such file or directory"
    assert line(str(folder), "--card", str(missing), "--output", out) == cannot
    apart = "give either recordings or results, or --policy"
    assert line(*usual) == apart
    assert line(str(folder), "--policy", "Move=a.pt", "--steps", "1", *usual) == apart
    assert line("--policy", "Move=a.pt", *usual) == "--policy and --steps go together"
    assert line(str(folder), "--unseen", *usual) == "--unseen is for --policy"
    kinds = "argument --policy: 'Move=a.bin' is not like Move=move.pt or Move=move.onnx"
    assert line("--policy", "Move=a.bin", "--steps", "1", *usual) == kinds
    absent = f"cannot read {tmp_path / 'a.pt'}: No such file or directory"
    assert line("--policy", f"Move={tmp_path / 'a.pt'}", "--steps", "1", *usual) == absent


def test_each_mistake_of_a_card_is_told(tmp_path: Path, card: Path, capsys: pytest.CaptureFixture) -> None:
    card.write_text(yaml.safe_dump(GOOD | {"budget": -1, "gradient": 3}))
    argv = [str(tmp_path), "--card", str(card), "--output", str(tmp_path / "x.plabsub.zip")]
    assert submit.main(argv) == 2
    assert capsys.readouterr().err.splitlines() == [
        f"plab: {card}: budget must be a whole number of environment steps",
        f"plab: {card}: gradient must be true or false",
    ]


def test_mistakes_of_verify(tmp_path: Path, path: Path, told: Callable[..., str]) -> None:
    assert told([str(tmp_path / "no")], verify.main) == f"plab: {tmp_path / 'no'} does not exist"
    empty = tmp_path / "empty"
    empty.mkdir()
    assert told([str(empty)], verify.main) == f"plab: {empty} has no submissions, files <name>.plabsub.zip"
    other = "use its plab (0.1.0, this is 0.1.0)"
    assert told([str(path)], verify.main) == (
        f"plab: {path}: the scene of Move-v1 is another one than here: give the overrides that it was made "
        f"with, or {other}"
    )
    with_manifest(path, lambda about: about.update(physics=99, plab="9.0"))
    here = f"this plab ({plab.__version__}) simulates version 1"
    assert told([str(path)], verify.main) == f"plab: {path} is of physics version 99 (plab 9.0), {here}"
    nothing = "plab: name a submission, or a folder of them"
    assert told(["sim.device=cpu"], verify.main) == nothing


def test_mistakes_of_leaderboard(tmp_path: Path, told: Callable[..., str]) -> None:
    missing = tmp_path / "no"
    assert told([str(missing)], leaderboard.main) == f"plab: there is no folder {missing}"


# ------------------------------------------------------------------------------------------------- the page


def real(variant: str, steps: int, score: float, **which: Any) -> Entry:
    place = Configuration("Move", variant)
    given = {"actions": ACTIONS} | which
    return Entry(place, Digests.of(place.config(())), steps, score, **given)


def handed_in(folder: Path, name: str, entries: tuple[Entry, ...], **card: Any) -> Path:
    made = folder / f"{name}.plabsub.zip"
    policies = {e.policy: b"" for e in entries if e.policy}
    write(Submission(dataclasses.replace(CARD, name=name, **card), entries, policies), made)
    return made


def judged(path: Path, scores: list[dict[str, float]], outcome: str = HOLDS) -> None:
    submission = read(path)
    pairs = zip(submission.entries, scores, strict=True)
    verdicts = tuple(Verdict(e, own, outcome, "" if outcome == HOLDS else "why") for e, own in pairs)
    write_verification(Verification(submission.digest, verdicts, ()), path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plans that hold, a policy that was not run, a lie, a recording, a foreign scene, rubbish."""
    folder = tmp_path_factory.mktemp("submissions")
    plans = (real("1", 900, 0.2), real("1", 9000, 0.8), real("2", 9000, 0.4))
    scores = [{"float32": s, "float64": s + 0.1} for s in (0.2, 0.8, 0.4)]
    judged(handed_in(folder, "plans", plans, gradient=True, description="<b>bold</b>"), scores)
    policy = tuple(real(v, 200_000, 0.6, actions=None, policy="policies/Move.pt") for v in ("1", UNSEEN[0]))
    judged(handed_in(folder, "policy", policy), [{}, {}], NOT_RUN)
    judged(handed_in(folder, "liar", (real("1", 100, 1.0),)), [{"float32": 0.1}], LIES)
    write(Submission(None, (real("1", 100, 0.5),)), folder / "recording.plabsub.zip")
    handed_in(folder, "foreign", (entry(),))
    (folder / "rubbish.plabsub.zip").write_bytes(b"rubbish")
    return folder


def test_scores_are_means_of_whole_tables_within_budgets(folder: Path) -> None:
    sections = {section.title: section for section in board(folder).sections}
    lines = {line.card.name: line for line in sections["plab's suite"].lines}
    plans = lines["plans"]
    assert plans.status == "verified" and plans.covered == 2
    expected = [0.2 / 50, 1.2 / 50, 1.2 / 50, 1.2 / 50]
    assert plans.budgets == pytest.approx(expected)
    assert plans.score == pytest.approx(1.2 / 50) and plans.exact == pytest.approx(1.4 / 50)
    assert plans.tasks[suite_tasks().index("Move")] == pytest.approx(1.2 / 5)
    assert plans.tasks[suite_tasks().index("Rope")] is None
    policy = lines["policy"]
    assert policy.status == "claimed" and policy.exact is None
    assert policy.budgets == (None, None, None, pytest.approx(0.6 / 50))
    (unseen,) = sections["Unseen configurations"].lines
    assert unseen.score == pytest.approx(0.6 / 100) and sections["Unseen configurations"].expected == 100


def test_what_does_not_belong_is_left_out_with_a_reason(folder: Path) -> None:
    said = dict.fromkeys(("foreign", "liar", "recording", "rubbish"))
    lines = board(folder).left_out
    assert len(lines) == 4
    for line in lines:
        name = next(name for name in said if f"{name}.plabsub.zip" in line)
        said[name] = line.removeprefix(str(folder / f"{name}.plabsub.zip"))
    assert said["foreign"] == ": the scene of Move-v1 is another one than on this leaderboard"
    assert said["liar"] == ": 1 claim(s) do not hold; why"
    assert said["recording"] == " has no card: python -m plab.submit makes a submission of recordings"
    assert said["rubbish"] == " is cut off, damaged or no zip file (File is not a zip file)"


def test_a_file_that_was_changed_afterwards_is_not_verified(folder: Path, tmp_path: Path) -> None:
    for path in folder.glob("plans.*"):
        shutil.copy(path, tmp_path)
    with_entry(tmp_path / "plans.plabsub.zip", score=0.9)
    assert read_verification(read(tmp_path / "plans.plabsub.zip")) is None
    (line,) = (one for one in board(tmp_path).sections[0].lines if one.card.name == "plans")
    assert line.status == "claimed"


def test_the_paper_and_own_runs_are_the_first_entries(tmp_path: Path) -> None:
    sections = {section.title: section for section in board(tmp_path).sections}
    paper = sections["The paper's table"]
    lines = {(line.card.name, line.status): line for line in paper.lines}
    assert len(lines) == len(paper.lines) == 9
    table = paper_table("iou_per_configuration").groupby("method")["iou_mean"].mean()
    assert lines["SAC", "printed"].score == pytest.approx(table["sac"])
    assert lines["SAC", "printed"].track == "policies" and lines["Adam", "printed"].card.gradient
    # 500,000 steps: not within 10^5, within 10^6.
    assert [value is None for value in lines["SAC", "printed"].budgets] == [True, True, True, False]
    assert [value is None for value in lines["Adam", "printed"].budgets] == [True, False, False, False]
    assert lines["Adam", "own runs"].covered == 50
    own = sections["plab's suite"].lines
    assert {(line.card.name, line.status, line.covered) for line in own} == {
        ("Adam", "own runs", 50),
        ("GD", "own runs", 50),
        ("Adam-H", "own runs", 50),
    }
    assert all(value is not None for value in own[0].tasks)


def test_the_page_shows_it_and_takes_no_text_for_html(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "page"
    assert leaderboard.main([str(folder), "--out", str(out)]) == 0
    text = (out / "index.html").read_text(encoding="utf-8")
    assert "&lt;b&gt;bold&lt;/b&gt;" in text and "<b>bold" not in text
    assert '<a href="https://example.org/mine" rel="nofollow noopener">plans</a>' in text
    assert "do not hold; why" in text
    assert text.count("<section>") == 5
    assert not re.findall(r'(?:src|href)="(?!https?://)', text)


def test_verification_is_kept_beside_the_file(folder: Path) -> None:
    found = read_verification(read(folder / "plans.plabsub.zip"))
    assert found is not None and found.outcomes == {HOLDS}
    kept = json.loads((folder / "plans.verified.json").read_text())
    assert kept["tolerance"] == TOLERANCE and kept["entries"][1]["scores"]["float64"] == pytest.approx(0.9)


def test_a_broken_verification_is_told(path: Path) -> None:
    kept = path.with_name("mine.verified.json")
    kept.write_text("{}")
    with pytest.raises(SubmissionError) as caught:
        read_verification(read(path))
    assert str(caught.value) == f"{kept} cannot be read ('submission'): verify the submission again"


@browsing
def test_the_page_filters_and_sorts(browser, folder: Path, tmp_path: Path) -> None:
    assert leaderboard.main([str(folder), "--out", str(tmp_path)]) == 0
    browser.get((tmp_path / "index.html").as_uri())
    table = "document.querySelector('.board')"

    def shown() -> list[str]:
        rows = f"[...{table}.tBodies[0].rows].filter((row) => !row.hidden)"
        texts = browser.execute_script(f"return {rows}.map((row) => row.cells[0].innerText)")
        return [text.splitlines()[0] for text in texts]

    assert shown() == ["Adam", "GD", "Adam-H", "plans", "policy"]
    press(browser, "[data-filter=track] button[value=policies]")
    assert shown() == ["policy"]
    press(browser, "[data-filter=gradient] button[value=yes]")
    assert shown() == ["Nothing of this track."]
    press(browser, "[data-filter=track] button[value='']")
    assert shown() == ["Adam", "GD", "Adam-H", "plans"]
    press(browser, ".board th button")
    assert shown() == ["Adam", "Adam-H", "GD", "plans"]
    press(browser, "#form button[value=tasks]")
    visible = f"[...{table}.tHead.rows[0].cells].filter((head) => head.offsetParent)"
    heads = browser.execute_script(f"return {visible}.map((head) => head.innerText.trim())")
    assert heads == ["method", "score", "status", *suite_tasks(), "configurations"]
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert errors == []

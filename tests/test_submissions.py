"""Submissions: files, cards, configurations, command lines, and leaderboard numbers."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
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
import refusals
import synthetic
from plab.cli.submissions import leaderboard, submit, verify
from plab.config import load_config
from plab.config.suite import suite_tasks
from plab.files import read_members
from plab.report.reference import paper_table
from plab.results import ResultsError
from plab.submissions import submission, verifying
from plab.submissions.board import board
from plab.submissions.submission import UNSEEN, Card, Configuration, Entry, Submission, read, write
from plab.submissions.verifying import HOLDS, LIES, NOT_RUN, TOLERANCE, Verdict, read_verification
from synthetic_runs import synthetic_run, template

ROOT = Path(__file__).resolve().parents[1]
CARD = Card("Mine", ["A. Author", "B. Author"], "https://example.org/mine", 10**9, "a laptop", False)
why = functools.partial(refusals.why, ResultsError)
GOOD = dataclasses.asdict(CARD)
CHECKSUM = "a" * 64
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 6))


def entry(variant: str = "1", steps: int = 100, score: float = 0.5, **which: Any) -> Entry:
    given = {"checksum": CHECKSUM, "actions": ACTIONS} | which
    return Entry(Configuration("Move", variant), steps=steps, score=score, **given)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A submission with two plans."""
    made = tmp_path / "mine.plabsub.zip"
    write(Submission(CARD, (entry(), entry("2", steps=5000))), made)
    return made


def changed(path: Path, **members: bytes) -> Path:
    """Replace members of a file; member names are given with ``_`` for special characters."""
    kept = read_members(path)
    names = {re.sub(r"\W", "_", name): name for name in kept}
    kept |= {names[key]: content for key, content in members.items()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in kept.items():
            archive.writestr(name, content)
    return path


def with_manifest(path: Path, values: dict[str, Any], entry: int | None = None) -> Path:
    """Change keys of a manifest, or of one of its entries."""
    about = json.loads(read_members(path)["manifest.json"])
    (about if entry is None else about["entries"][entry]).update(values)
    return changed(path, manifest_json=json.dumps(about).encode())


def test_round_trip_of_plans(path: Path) -> None:
    found = read(path)
    assert found.card == CARD and found.plab == plab.__version__ and found.track == "plans"
    entries = [(e.configuration.name, e.steps, e.score) for e in found.entries]
    assert entries == [("Move-v1", 100, 0.5), ("Move-v2", 5000, 0.5)]
    assert all(np.array_equal(e.actions, ACTIONS) and e.checksum == CHECKSUM for e in found.entries)
    assert submission.encode(found) == path.read_bytes()
    wrong = path.with_name("mine.zip")
    assert str(wrong) in why(write, found, wrong)


def test_files_that_are_damaged_or_lead_elsewhere(path: Path) -> None:
    whole = path.read_bytes()
    for content in (whole[:-30], b"", b"not a zip file at all", whole[:200] + bytes(200) + whole[400:]):
        path.write_bytes(content)
        assert str(path) in why(read, path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../out", b"/etc/passwd")
    assert "no manifest.json" in why(read, path)
    path.unlink()
    assert str(path) in why(read, path)


def test_sizes_are_bounded_before_anything_is_unpacked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(5_000_000))
    content = bytearray(path.read_bytes())
    assert len(content) < 10_000 and len(read_members(path)["zeros"]) == 5_000_000
    with monkeypatch.context() as patch:
        patch.setattr(submission, "_TOTAL_BYTES", 2 * 10**6)
        assert "2 MB" in why(read, path)
    # An unpacked size in the directory that is not true.
    place = content.index(b"PK\x01\x02") + 24
    content[place : place + 4] = struct.pack("<I", 10)
    path.write_bytes(content)
    assert str(path) in why(read, path)


def npy(array: np.ndarray, **options: Any) -> bytes:
    content = io.BytesIO()
    np.save(content, array, **options)
    return content.getvalue()


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\x93NUMPY\x01\x00rubbish", "not a NumPy array"),
        (npy(ACTIONS)[:-8], "not a NumPy array"),
        # More than memory has, says the header.
        (npy(np.zeros((10, 3))).replace(b"(10, 3)", b"(99, 9)"), "not a NumPy array"),
        (npy(ACTIONS * 1.1), "[-1, 1]"),
        (npy(ACTIONS * np.nan), "[-1, 1]"),
        (npy(np.array([[print]], object), allow_pickle=True), "NumPy"),
        (npy(ACTIONS.astype("<f4")), "float64"),
        (npy(ACTIONS[0]), "shape"),
    ],
)
def test_actions_that_are_refused(path: Path, content: bytes, fault: str) -> None:
    line = why(read, changed(path, actions_0001_npy=content))
    assert "actions/0001.npy" in line and fault in line


@pytest.mark.parametrize(
    ("place", "values", "named"),
    [
        (None, {"format": 7}, "layout 7"),
        (None, {"entries": None}, "manifest"),
        (1, {"task": ["Move"]}, "['Move']"),
        (1, {"variant": "random7"}, "'random7'"),
        (1, {"score": 10**400}, "score"),
        (1, {"score": float("nan")}, "score"),
        (1, {"steps": True}, "steps"),
        (1, {"file": "actions/9.npy"}, "actions/9.npy"),
        (1, {"file": "card.yaml"}, "card.yaml"),
    ],
)
def test_manifests_that_are_refused(path: Path, place: int | None, values: dict, named: str) -> None:
    assert named in why(read, with_manifest(path, values, place))


def test_the_budget_of_a_card_bounds_the_steps(tmp_path: Path) -> None:
    made = tmp_path / "x.plabsub.zip"
    # Of each configuration the most, of all the sum.
    entries = (entry(steps=100), entry(steps=3000), entry("2", steps=2500))
    write(Submission(dataclasses.replace(CARD, budget=5500), entries), made)
    assert len(read(made).entries) == 3
    write(Submission(dataclasses.replace(CARD, budget=5499), entries), made)
    line = why(read, made)
    assert "budget of 5,499" in line and "5,500" in line


def test_cards_that_are_read() -> None:
    assert submission.parse_card(yaml.safe_dump(GOOD).encode(), "card.yaml") == CARD
    del (short := dict(GOOD))["description"]
    assert submission.parse_card(yaml.safe_dump(short).encode(), "card.yaml") == CARD
    example = (ROOT / "examples" / "outside_agent" / "card.yaml").read_text(encoding="utf-8")
    assert submission.parse_card(example.encode(), "card.yaml").name == "PPO in one file"
    assert example in (ROOT / "docs" / "submissions.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("a: &a {x: 1}\nb: *a", "alias"),
        ("budget: 0x" + "f" * 7000, "budget"),
        ('name: "\\e[31mred"', "control"),
        ('authors: ["\\ud800"]', "control"),
        ("name: " + "[" * 3000 + "]" * 3000, "recursion"),
    ],
)
def test_cards_that_are_refused(line: str, fault: str) -> None:
    assert fault in why(submission.parse_card, f"{yaml.safe_dump(GOOD)}{line}".encode(), "card.yaml")


def test_configurations_have_their_names_and_compose_themselves() -> None:
    names = {
        "Rope-v3": ["task=Rope", "variant=3"],
        f"Move-v{UNSEEN[2]}": ["task=Move", "variant=random", f"seed_scene={UNSEEN[2][6:]}"],
    }
    for name, words in names.items():
        cfg = load_config(words)
        configuration = submission.configuration_of(cfg)
        assert configuration.name == name
        assert submission.checksum(configuration.config()) == submission.checksum(cfg)
    drawn = load_config(["task=Move", "variant=random", "seed_scene=3"])
    assert "Move-vrandom3" in why(submission.configuration_of, drawn)
    for word in ("protocol.floor=release", "targets.source=there", "task.name=Mine"):
        assert "protocol=plab" in why(submission.configuration_of, load_config(["task=Move", word]))


def result(folder: Path, variant: str = "1", seed: int = 0) -> Path:
    config = template("adam", [f"results_dir={folder}", "task=Move", f"variant={variant}", f"seed={seed}"])
    return synthetic.save(synthetic_run(config, rows=4, score=0.4))


def test_results_become_a_submission(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder, out, card = (tmp_path / name for name in ("results", "out.plabsub.zip", "card.yaml"))
    card.write_text(yaml.safe_dump(GOOD))
    for variant in "12":
        result(folder, variant)
    result(folder, seed=1)
    assert submit([str(folder), "seed=0", "--card", str(card), "--output", str(out)]) == 0
    assert capsys.readouterr().out.startswith(f"{out}: plans for 2 configuration(s), ")
    found = read(out)
    assert [e.configuration.name for e in found.entries] == ["Move-v1", "Move-v2"]
    assert found.entries[0].score == pytest.approx(0.4)
    assert found.entries[0].steps % 50 == 0 and 50 <= found.entries[0].steps <= 200
    assert found.entries[0].checksum == submission.checksum(load_config(["task=Move"]))


def test_mistakes_of_verify_and_leaderboard(tmp_path: Path, path: Path, told: Callable[..., str]) -> None:
    missing = str(tmp_path / "no")
    (empty := tmp_path / "empty").mkdir()
    for source in (missing, str(empty), "sim.device=cpu"):
        named = "name a submission" if "=" in source else source
        assert named in told([source], verify)
    assert missing in told([missing], leaderboard)
    line = told([str(path)], verify)
    assert str(path) in line and "target of Move-v1" in line
    with_manifest(path, {"physics": 99, "plab": "9.0"})
    line = told([str(path)], verify)
    assert "physics version 99" in line and "9.0" in line


def real(variant: str, steps: int, score: float, **which: Any) -> Entry:
    own = submission.checksum(Configuration("Move", variant).config())
    return entry(variant, steps, score, checksum=own, **which)


def handed_in(folder: Path, name: str, entries: tuple[Entry, ...], **card: Any) -> Path:
    made = folder / f"{name}.plabsub.zip"
    policies = {e.policy: b"" for e in entries if e.policy}
    write(Submission(dataclasses.replace(CARD, name=name, **card), entries, policies), made)
    return made


def judged(path: Path, scores: list[float], outcome: str = HOLDS) -> None:
    submission = read(path)
    pairs = zip(submission.entries, scores, strict=True)
    verdicts = [Verdict(e, own, outcome, "" if outcome == HOLDS else "why") for e, own in pairs]
    verifying.write_verification(verdicts, submission, ())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Valid plans, a policy that was not run, a false claim, a recording, damaged files."""
    folder = tmp_path_factory.mktemp("submissions")
    plans = (real("1", 900, 0.2), real("1", 10_000, 0.8), real("2", 9000, 0.4))
    judged(handed_in(folder, "plans", plans, gradient=True, description="<b>bold</b>"), [0.2, 0.8, 0.4])
    policy = tuple(real(v, 200_000, 0.6, actions=None, policy="policies/Move.pt") for v in ("1", UNSEEN[0]))
    judged(handed_in(folder, "policy", policy), [np.nan] * 2, NOT_RUN)
    judged(handed_in(folder, "liar", (real("1", 100, 1.0),)), [0.1], LIES)
    write(Submission(None, (real("1", 100, 0.5),)), folder / "recording.plabsub.zip")
    handed_in(folder, "foreign", (entry(),))
    handed_in(folder, "short", (real("1", 100, 0.5, actions=ACTIONS[:9]),))
    (folder / "rubbish.plabsub.zip").write_bytes(b"rubbish")
    changed(handed_in(folder, "deep", (entry(),)), manifest_json=b"[" * 100_000)
    handed_in(folder, "believed", (real("1", 100, 0.5),))
    (folder / "believed.verified.json").write_text("[" * 100_000)
    return folder


@pytest.fixture(scope="module")
def leaders(folder: Path) -> tuple[dict[str, dict], list[str]]:
    """Sections of the leaderboard by title, and what is left out."""
    sections, left_out = board(folder)
    return {section["title"]: section for section in sections}, left_out


def test_scores_are_means_of_whole_tables_within_budgets(leaders) -> None:
    sections, _ = leaders
    lines = {line["card"].name: line for line in sections["plab's suite"]["lines"]}
    plans = lines["plans"]
    assert plans["status"] == "verified" and plans["covered"] == 2
    assert plans["budgets"] == pytest.approx([0.2 / 50, 1.2 / 50, 1.2 / 50, 1.2 / 50])
    assert plans["score"] == pytest.approx(1.2 / 50)
    assert plans["tasks"][suite_tasks().index("Move")] == pytest.approx(1.2 / 5)
    assert plans["tasks"][suite_tasks().index("Rope")] is None
    policy = lines["policy"]
    assert policy["status"] == "claimed" and policy["budgets"] == [None, None, None, pytest.approx(0.6 / 50)]
    unseen = sections["Unseen configurations"]
    assert (unseen["lines"][0]["score"], unseen["expected"]) == (pytest.approx(0.6 / 100), 100)


def test_what_does_not_belong_is_left_out_with_a_reason(leaders, folder: Path) -> None:
    reasons = {"believed": "decoding a JSON", "deep": "decoding a JSON", "foreign": "target of Move-v1"}
    reasons |= {"liar": "1 claim", "recording": "card", "rubbish": "zip", "short": "shape"}
    for line, (name, reason) in zip(sorted(leaders[1]), reasons.items(), strict=True):
        assert line.startswith(str(folder / f"{name}.")) and reason in line
    assert all(part in line for part in ("Move-v1", "[9, 6]", "[50, 6]"))


def test_verification_is_kept_beside_the_file_and_is_of_its_bytes(folder: Path, tmp_path: Path) -> None:
    assert {one.outcome for one in read_verification(read(folder / "plans.plabsub.zip"))} == {HOLDS}
    kept = json.loads((folder / "plans.verified.json").read_text())
    assert kept["tolerance"] == TOLERANCE and kept["entries"][1]["score"] == 0.8
    for path in folder.glob("plans.*"):
        shutil.copy(path, tmp_path)
    path = with_manifest(tmp_path / "plans.plabsub.zip", {"score": 0.9}, 1)
    assert read_verification(read(path)) == []
    (line,) = (one for one in board(tmp_path)[0][0]["lines"] if one["card"].name == "plans")
    assert line["status"] == "claimed"
    (tmp_path / "plans.verified.json").write_text("{}")
    assert "plans.verified.json" in why(read_verification, read(path))
    for values in ({"score": [1]}, {"score": np.nan}, {"score": 10**400}, {"outcome": "true"}):
        judged(path, [0.5] * 3)
        record = json.loads((tmp_path / "plans.verified.json").read_text())
        record["entries"][0] |= values
        (tmp_path / "plans.verified.json").write_text(json.dumps(record))
        assert "Move-v1 after" in why(read_verification, read(path))


def test_the_papers_numbers_are_a_table(leaders) -> None:
    paper = leaders[0]["The paper's table"]
    lines = {(line["card"].name, line["status"]): line for line in paper["lines"]}
    assert len(lines) == len(paper["lines"]) == 6
    table = paper_table("iou_per_configuration").groupby("method")["iou_mean"].mean()
    assert lines["SAC", "printed"]["score"] == pytest.approx(table["sac"])
    assert lines["SAC", "printed"]["track"] == "policies" and lines["Adam", "printed"]["card"].gradient
    # 500,000 steps: not within 10^5, within 10^6.
    assert [value is None for value in lines["SAC", "printed"]["budgets"]] == [True, True, True, False]
    assert [value is None for value in lines["Adam", "printed"]["budgets"]] == [True, False, False, False]


def test_the_page_shows_it_and_takes_no_text_for_html(folder: Path, tmp_path: Path) -> None:
    assert leaderboard([str(folder), "--output", str(tmp_path)]) == 0
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "&lt;b&gt;bold&lt;/b&gt;" in text and "<b>bold" not in text
    assert '<a href="https://example.org/mine" rel="nofollow noopener">plans</a>' in text
    assert "do not hold; why" in text and text.count("<section>") == 3
    assert not re.findall(r'(?:src|href)="(?!https?://)', text)

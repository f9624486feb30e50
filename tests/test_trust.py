"""Untrusted files: nothing is unpickled or imported, no path leaves its folder, sizes are limited."""

from __future__ import annotations

import dataclasses
import functools
import io
import lzma
import os
import pickle
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium.spaces import Box

import refusals
import synthetic
from plab.cli import status
from plab.config import build_scene, load_config
from plab.config.families import FAMILIES
from plab.results import ResultsError, check, read, unpack
from plab.runners.policy import Policy, Spaces, first_policy, load_policy, policy_path, save_policy
from plab.scenes import Scene
from plab.targets import TargetError, load_release_target

said = functools.partial(refusals.why, (ResultsError, TargetError))
RUN = "Rope-v1/adam/seed0.h5"


class Marker:
    """Object that creates a folder when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


def saved(folder: Path, **changes: Any) -> Path:
    """Write a finished run with changed attributes, and return its file."""
    path = synthetic.save(synthetic.run(folder))
    with h5py.File(path, "r+") as file:
        file.attrs.update(changes)
    return path


def zipped(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return members as the bytes of a zip file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as archive:
        # Of names that are there twice.
        warnings.simplefilter("ignore")
        for name, own in members:
            archive.writestr(name, own)
    return buffer.getvalue()


def target_scene() -> Scene:
    settings = ("sim.grid_size=16", "sim.dt=4e-4", "sim.substeps=5", "sim.particles_scale=0.03")
    return build_scene(load_config(["task=Torus", *settings]))


def make_target(folder: Path) -> Path:
    """Write a target file in the release's format."""
    scene = target_scene()
    mass = np.zeros((16, 16, 16))
    mass[4:8, 1:3, 4:8] = scene.particle_count * scene.particle_mass / 32
    folder.mkdir(parents=True)
    np.save(folder / "Torus3D-v1.npy", mass)
    return folder / "Torus3D-v1.npy"


def make_policy(folder: Path) -> Path:
    """Write an untrained policy next to a result."""
    method = load_config(["task=Move", "method=ppo", "method.hidden=[4]"]).method
    bounds = np.arange(5, dtype=np.float32)
    spaces = Spaces(Box(-bounds, bounds), Box(-1.0, 1.0, (3,), np.float32))
    policy = Policy(first_policy(method, spaces), np.zeros(5), np.ones(5))
    folder.mkdir(parents=True)
    save_policy(folder / "run.h5", method, policy)
    return policy_path(folder / "run.h5")


# ----------------------------------------------------------------------------------------------- result files


def test_links_and_data_elsewhere_are_not_followed(tmp_path: Path) -> None:
    secret, raw = tmp_path / "secret", tmp_path / "raw"
    with h5py.File(secret, "w") as file:
        file["actions"] = np.full((50, 6), 0.5)
    raw.write_bytes(bytes(64))
    for number, link in enumerate((h5py.ExternalLink(str(secret), "/actions"), None)):
        path = saved(tmp_path / str(number))
        with h5py.File(path, "r+") as file:
            del file["best/actions"]
            if link is None:
                file["best"].create_dataset("actions", (4,), float, external=[(str(raw), 0, 32)])
            else:
                file["best/actions"] = link
        line = said(read, path)
        assert str(path) in line and "actions" in line


def test_arrays_that_the_file_does_not_hold(tmp_path: Path) -> None:
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["best/actions"]
        file["best"].create_dataset("actions", (10**12,), float, chunks=(10**6,))
        mass = file["mass"].create_group("final")
        mass.attrs["shape"], mass["index"], mass["value"] = [2**20] * 3, [0], [1.0]
    assert "actions claims 8000000000000 bytes" in said(read, path)
    with h5py.File(path, "r+") as file:
        del file["best/actions"]
    assert f"mass/final claims {2**60} entries" in said(read, path)


# ------------------------------------------------------------------------------------------------ archives


ARCHIVES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "method": (lambda own: zipped([(RUN, own)], zipfile.ZIP_LZMA), f"'{RUN}'"),
    "bomb": (lambda own: zipped([(RUN, bytes(200_000_000))]), "200000000"),
    "packed bomb": (lambda own: zipped([(RUN, bytes(40_000_000))], zipfile.ZIP_STORED), "16777216"),
    "zip in zip": (lambda own: zipped([("b.plab.zip.xz", zipped([(RUN, own)]))]), "b.plab.zip.xz"),
}


@pytest.mark.parametrize("case", ARCHIVES)
def test_archives_that_are_refused(tmp_path: Path, case: str) -> None:
    make, named = ARCHIVES[case]
    archive, out = tmp_path / "a.plab.zip.xz", tmp_path / "out"
    archive.write_bytes(lzma.compress(make(saved(tmp_path / "results").read_bytes()), preset=0))
    line = said(unpack, archive, out)
    assert line.startswith(str(archive)) and named in line and not out.exists()
    ((_, problem),) = check(archive)
    assert problem and problem in line


def test_runs_do_not_choose_where_they_are_unpacked(tmp_path: Path) -> None:
    archive, path = tmp_path / "a.plab.zip.xz", tmp_path / "away.h5"
    for name in ("../../../away", "/away", "a/../../../../away"):
        config = synthetic.config(tmp_path, task=name)
        synthetic.write(dataclasses.replace(synthetic.run(tmp_path), config=config), path)
        archive.write_bytes(lzma.compress(zipped([("run.h5", path.read_bytes())]), preset=0))
        assert f"'{name}'" in said(unpack, archive, tmp_path / "out") and not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------ arrays


def test_targets_are_arrays_alone(tmp_path: Path) -> None:
    path, marker = make_target(tmp_path / "files"), tmp_path / "marker"

    def refused() -> None:
        assert str(path) in said(load_release_target, path.parent, target_scene(), "1")

    np.save(path, np.array([Marker(marker)], dtype=object), allow_pickle=True)
    refused()
    path.write_bytes(pickle.dumps(Marker(marker)))
    refused()
    path.unlink()
    os.mkfifo(path)
    refused()
    assert not marker.exists()


def test_policies_are_arrays_alone(tmp_path: Path) -> None:
    path, marker = make_policy(tmp_path / "run"), tmp_path / "marker"
    with np.load(path) as file:
        sound = dict(file)
    assert all(array.dtype.kind in "fU" for array in sound.values())
    header, weight = str(sound["header"]), "policy/mlp_extractor.policy_net.0.weight"
    for arrays, named in (
        (sound | {"mean": np.array([Marker(marker)], dtype=object)}, "mean"),
        (sound | {weight: sound[weight][:, :2]}, "torch.Size([4, 2])"),
        (sound | {"header": np.array(header.replace("[4]", "[100000, 100000]"))}, "10000800000"),
        (sound | {"header": np.array(header.replace('"ppo"', '"${oc.env:HOME}"', 1))}, "method"),
    ):
        np.savez(path, **arrays)
        line = said(load_policy, path.with_name("run.h5"))
        assert str(path) in line and named in line
    assert not marker.exists()


def test_no_file_chooses_what_is_imported(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "zz_evil.py").write_text(f"import os; os.mkdir({str(tmp_path / 'marker')!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = make_policy(tmp_path / "run")
    with np.load(path) as file:
        arrays = dict(file)
    text = str(arrays["header"]).replace('"family": "rl"', '"family": "zz_evil:FAMILY"')
    np.savez(path, **arrays | {"header": np.array(text)})
    assert "zz_evil" in said(load_policy, path.with_name("run.h5"))
    run = synthetic.run(tmp_path / "results")
    run.config["method"]["family"] = "zz_evil:FAMILY"
    path = synthetic.save(run)
    assert read(path).config["method"]["family"] not in FAMILIES and status.main([str(path)]) in (0, 2)
    list(check(path))
    assert "zz_evil" not in sys.modules and not (tmp_path / "marker").exists()

"""Datasets in Minari's format (Farama Foundation): HDF5, and metadata in JSON.

A dataset is a folder ``<namespace>/<name>-v<k>/data`` with two files. ``main_data.hdf5`` has one group per
episode, with observations and infos of T + 1 states, and actions, rewards, terminations and truncations of T
steps; ``metadata.json`` has the spaces. The package minari can read them, but is not required.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Space

from plab.errors import PlabError
from plab.files import complete_folder

EXAMPLE = Path(__file__).parent / "dataset"
"""The dataset ``example``: ``plab dataset task=Move observe_particles=20``."""

VERSION = "0.5.4"
"""Version of Minari's format."""


class DatasetError(PlabError, ValueError):
    """Unreadable or unwritable dataset; the message names it and the reason."""


@dataclass(frozen=True)
class Episode:
    """An episode of T steps, truncated in the last step.

    Attributes:
        observations: Observations before each step and after the last, shape [T + 1, ...], or by key.
        actions: Actions, shape [T, A].
        rewards: Rewards, shape [T].
        infos: Measures of the states, by name, shape [T + 1] each; sampled parameters are under
            ``randomized``, by dotted key, shape [T + 1, ...] each.
        attributes: Attributes of the episode: numbers and strings by name.
    """

    observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    infos: Mapping[str, Any]
    attributes: Mapping[str, Any]


def write_dataset(
    folder: Path,
    name: str,
    episodes: Iterable[Episode],
    spaces: tuple[Space[Any], Space[Any]],
    env_spec: EnvSpec,
    about: Mapping[str, Any],
) -> list[Mapping[str, Any]]:
    """Write a dataset atomically; return the attributes of the episodes.

    Args:
        folder: Folder of datasets, such as ``MINARI_DATASETS_PATH``.
        name: Name of the dataset, such as ``plab/Move-v0``.
        episodes: Episodes, held in memory one at a time.
        spaces: Spaces of observations and actions.
        env_spec: Environment specification for minari's ``recover_environment``.
        about: Additional metadata.

    Raises:
        DatasetError: If the dataset exists, or there are no episodes.
    """
    place = folder / name / "data"
    if place.exists():
        raise DatasetError(f"{place.parent} exists: remove it, or choose another name with --name")
    with complete_folder(place) as beside:
        attributes, steps = [], 0
        with h5py.File(beside / "main_data.hdf5", "w", track_order=True) as file:
            for number, episode in enumerate(episodes):
                length, group = len(episode.rewards), file.create_group(f"episode_{number}")
                group.attrs.update({"id": number, "total_steps": length, **episode.attributes})
                ends = np.arange(length) == length - 1
                arrays = {"terminations": np.zeros(length, bool), "truncations": ends}
                names = ("observations", "actions", "rewards", "infos")
                _write(group, {name: getattr(episode, name) for name in names} | arrays)
                attributes.append(episode.attributes)
                steps += length
        if not attributes:
            raise DatasetError(f"{name}: there are no episodes to write")
        metadata = {
            "dataset_id": name,
            "minari_version": VERSION,
            "data_format": "hdf5",
            "jpeg_encoding": False,
            "total_episodes": len(attributes),
            "total_steps": steps,
            "dataset_size": round((beside / "main_data.hdf5").stat().st_size / 1e6, 1),
            "observation_space": json.dumps(_described(spaces[0])),
            "action_space": json.dumps(_described(spaces[1])),
            "env_spec": env_spec.to_json(),
            **about,
        }
        (beside / "metadata.json").write_text(json.dumps(metadata), encoding="utf-8")
    return attributes


def _write(group: h5py.Group, arrays: Mapping[str, Any]) -> None:
    for name, values in arrays.items():
        if isinstance(values, Mapping):
            _write(group.create_group(name), values)
        else:
            # Minari appends to datasets without a maximum shape.
            shape = (None, *values.shape[1:])
            group.create_dataset(name, data=values, maxshape=shape, chunks=values.shape, compression="gzip")


def _described(space: Space[Any]) -> dict[str, Any]:
    """Return the description of a space for Minari's metadata."""
    if isinstance(space, Dict):
        return {"type": "Dict", "subspaces": {key: _described(own) for key, own in space.items()}}
    assert isinstance(space, Box)
    bounds = {"low": space.low.tolist(), "high": space.high.tolist()}
    return {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape), **bounds}


# ---------------------------------------------------------------------------------------------------- reading


def metadata_of(path: str | Path) -> dict[str, Any]:
    """Return the metadata of a dataset, with the folder of its files as ``path``. The dataset is given by its
    folder, the subfolder ``data``, or as ``example``. Raise DatasetError if it does not exist."""
    path = EXAMPLE if str(path) == "example" else Path(path).expanduser()
    for place in (path / "data", path):
        if (file := place / "metadata.json").is_file():
            try:
                return json.loads(file.read_text(encoding="utf-8")) | {"path": place}
            except ValueError as error:
                raise DatasetError(f"{file} cannot be read: {error}") from error
    raise DatasetError(f"{path} is not a dataset: it has no data/metadata.json; write one with plab dataset")


def read_episodes(path: str | Path, limit: int | None = None) -> Iterator[Episode]:
    """Yield at most ``limit`` episodes of a dataset, in order; raise DatasetError if it cannot be read."""
    metadata = metadata_of(path)
    file = metadata["path"] / "main_data.hdf5"
    try:
        with h5py.File(file) as opened:
            for number in range(min(metadata["total_episodes"], limit or metadata["total_episodes"])):
                group = opened[f"episode_{number}"]
                found = {name: _read(item) for name, item in group.items()}
                seen, actions, rewards = (found[name] for name in ("observations", "actions", "rewards"))
                yield Episode(seen, actions, rewards, found.get("infos", {}), dict(group.attrs))
    except (OSError, KeyError) as error:
        raise DatasetError(f"{file} cannot be read: {' '.join(str(error).split())}") from error


def _read(item: Any) -> Any:
    return {key: _read(own) for key, own in item.items()} if isinstance(item, h5py.Group) else item[()]

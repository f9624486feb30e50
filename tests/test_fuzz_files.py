"""Files that are not what they should be, thousands of them: they are read, or refused in one line.

Files are changed byte by byte, and, where chance would not find its way, part by part: HDF5 groups, data
sets, attributes and links, the configuration inside, headers of arrays, members of archives, words of YAML.
What was found so far is among the cases of ``test_every_odd_part_is_answered``, and in tests/test_trust.py.
"""

from __future__ import annotations

import io
import json
import lzma
import struct
import traceback
import warnings
import zipfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium.spaces import Box
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import synthetic
from plab.cli import status
from plab.config import Config, ConfigError, build_scene, load_config
from plab.config.selection import Selection, SelectionError
from plab.mesh import load_mesh
from plab.report.collect import MixedRunsError, collect, collect_ablation
from plab.report.series import load_series
from plab.results import ResultsError, check, load, pack, read
from plab.runners.policy import load_policy, policy_path, save_policy
from plab.runners.rl_models import Spaces, model_kind
from plab.scene import SceneError
from plab.shape_files import ShapeError
from plab.targets import TargetError, load_release_target

OWN = (ResultsError, TargetError, ConfigError, SceneError, SelectionError, MixedRunsError, ShapeError)

CASES = {"few": 34, "many": 334}
"""Cases of each of the seven kinds of files, in CI and in the slow tests: 238 and 2,338."""

QUICK = ("sim.grid_size=16", "sim.dt=4e-4", "sim.substeps=5", "sim.horizon=2", "sim.particles_scale=0.03")

TASK = (Path(__file__).resolve().parents[1] / "conf" / "task" / "Torus.yaml").read_text(encoding="utf-8")


# ------------------------------------------------------------------------------------------------ sound files


def make_result(folder: Path) -> Path:
    """A finished run with mass tensors."""
    run = synthetic.run(folder)
    run.masses = {"final": np.pad(np.full((2, 2, 2), 0.5), 31)}
    return synthetic.save(run)


def make_partial(folder: Path) -> Path:
    """A run that has stopped, with a state to go on from."""
    run = synthetic.run(folder)
    run.status, run.message, run.evaluation = "stopped", "interrupted", {}
    moments = {"step": np.float32(3), "exp_avg": np.zeros((50, 6))}
    run.resume = {"actions": run.best_actions / 2, "optimizer": moments, "random": np.zeros(9, np.uint8)}
    return synthetic.save(run)


def make_archive(folder: Path) -> Path:
    """An archive of two runs."""
    for seed in (0, 1):
        synthetic.save(synthetic.run(folder / "runs", seed=seed))
    pack(folder / "runs", folder / "all.plab.zip.xz")
    return folder / "all.plab.zip.xz"


def make_target(folder: Path) -> Path:
    """A target as the release has them."""
    scene = build_scene(load_config(["task=Torus", *QUICK]))
    mass = np.zeros((16, 16, 16))
    mass[4:8, 1:3, 4:8] = scene.particle_count * scene.particle_mass / 32
    folder.mkdir(parents=True)
    np.save(folder / "Torus3D-v1.npy", mass)
    return folder / "Torus3D-v1.npy"


def make_policy(folder: Path) -> Path:
    """An untrained policy beside a result."""
    method = load_config(["task=Move", "method=ppo", "method.hidden=[4]"]).method
    bounds = np.arange(5, dtype=np.float32)
    spaces = Spaces(Box(-bounds, bounds), Box(-1.0, 1.0, (3,), np.float32))
    policy = model_kind(method.family, method.algorithm).policy(method, spaces)
    folder.mkdir(parents=True)
    save_policy(folder / "run.h5", method, policy, (np.zeros(5), np.ones(5)))
    return policy_path(folder / "run.h5")


def make_task(folder: Path) -> Path:
    """A task of the user's own."""
    (folder / "task").mkdir(parents=True)
    path = folder / "task" / "Own.yaml"
    path.write_text(TASK.replace("name: Torus", "name: Own"), encoding="utf-8")
    return path


# ----------------------------------------------------------------------------------------------- reading them


def make_mesh(folder: Path) -> Path:
    """An octahedron in binary PLY."""
    faces = [(x, 2 + y, 4 + z)[:: 1 if (x + y + z) % 2 == 0 else -1] for x, y, z in np.ndindex(2, 2, 2)]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 6"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += ["element face 8", "property list uchar int vertex_indices", "end_header"]
    corners = np.kron(np.eye(3), [[1], [-1]]).astype("<f4").tobytes()
    folder.mkdir(parents=True)
    content = (
        "\n".join(header).encode() + b"\n" + corners + b"".join(struct.pack("<B3i", 3, *f) for f in faces)
    )
    (folder / "it.ply").write_bytes(content)
    return folder / "it.ply"


def read_results(path: Path) -> None:
    """Do with a result file or an archive all that is done with one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        load(path, database=False)
    for place, problem in check(path):
        assert problem is None or "\n" not in problem.reason + problem.advice
        answered(lambda place=place: read(place))
    # What is said is another test's; here it is to be said at all.
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        assert status.main([str(path), "task=Rope", "variant=1"]) in (0, 2)
    answered(lambda: load_series(collect(path, Selection())))
    answered(lambda: collect_ablation(path, Selection(), "task.yield_stress"))


def read_target(path: Path) -> None:
    """Load the target for the scene that it was made for."""
    assert load_release_target(path.parent, _scene(), "1").shape == (16, 16, 16)


def read_policy(path: Path) -> None:
    """Load the policy, and have it act."""
    policy = load_policy(str(path).removesuffix(".policy.npz") + ".h5")
    size = policy.network.observation_space.shape[0]
    assert policy(np.zeros((2, size), np.float32)).shape[0] == 2


def read_task(path: Path) -> None:
    """Compose a configuration with the task."""
    assert isinstance(load_config(["task=Own"], path.parents[1]), Config)


def read_mesh(path: Path) -> None:
    """Load the mesh, and draw points inside."""
    mesh = load_mesh(str(path))
    assert mesh.fill(10, np.random.default_rng(0).random).shape == (10, 3) and mesh.thickness > 0


_scenes: list[Any] = []


def _scene() -> Any:
    if not _scenes:
        _scenes.append(build_scene(load_config(["task=Torus", *QUICK])))
    return _scenes[0]


KINDS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]] = {
    "result": (make_result, read_results),
    "partial": (make_partial, read_results),
    "archive": (make_archive, read_results),
    "target": (make_target, read_target),
    "policy": (make_policy, read_policy),
    "task": (make_task, read_task),
    "mesh": (make_mesh, read_mesh),
}


def answered(reading: Callable[[], Any]) -> str | None:
    """Read something; return what is said of it if it is refused, which has to be a line by plab."""
    try:
        reading()
    except OWN as error:
        assert str(error) and "\n" not in str(error), str(error)
        return str(error)
    except Exception as error:
        # In few words: where it came from can be as deep as Python goes.
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error!s:.300}, in {last.filename}, line {last.lineno}"
        pytest.fail(text, pytrace=False)
    return None


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A sound file of each kind."""
    folder = tmp_path_factory.mktemp("sound")
    return {kind: make(folder / kind) for kind, (make, _) in KINDS.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_sound_files_are_read(sound: dict[str, Path], kind: str) -> None:
    assert answered(lambda: KINDS[kind][1](sound[kind])) is None


# ------------------------------------------------------------------------------------------------ bytes

PLACE = st.floats(0, 1, exclude_max=True)
BYTES = st.one_of(
    st.tuples(st.just("flip"), PLACE, st.integers(1, 255)),
    st.tuples(st.just("cut"), PLACE, st.just(0)),
    st.tuples(st.just("drop"), PLACE, st.integers(1, 64)),
    st.tuples(st.just("zero"), PLACE, st.integers(1, 512)),
    st.tuples(st.just("double"), PLACE, st.integers(1, 512)),
)


def changed_bytes(content: bytes, change: tuple[str, float, int]) -> bytes:
    """Change bytes at a place, which is a share of the length."""
    how, share, size = change
    at = int(share * len(content))
    head, tail = content[:at], content[at:]
    if how == "flip":
        return head + bytes(byte ^ size for byte in tail[:1]) + tail[1:]
    if how == "cut":
        return head
    if how == "drop":
        return head + tail[size:]
    return head + (bytes(len(tail[:size])) + tail[size:] if how == "zero" else tail[:size] + tail)


# ------------------------------------------------------------------------------------------------ values

ODD: dict[str, Any] = {
    "text": "text",
    "digits": "3",
    "markup": "[/red] \x1b[2J\n",
    "up": "../../up",
    "minus": -1,
    "huge": 2**62,
    "nan": float("nan"),
    "infinite": float("inf"),
    "yes": True,
    "list": [1, "a", None],
    "table": {"a": {"b": 1}},
    "nothing": None,
}


def changed_json(text: str, change: tuple[float, str]) -> str:
    """Change a value somewhere inside a JSON text."""
    share, odd = change
    tree = json.loads(text)
    places = list(_places(tree, [None, None]))
    parent, key = places[int(share * len(places))]
    if parent is None:
        return json.dumps(ODD[odd])
    parent[key] = ODD[odd]
    return json.dumps(tree)


def _places(node: Any, place: list[Any]) -> Any:
    yield tuple(place)
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in list(entries):
        yield from _places(value, [node, key])


# ------------------------------------------------------------------------------------------------ HDF5

ATTRIBUTES: dict[str, Any] = {
    **{name: value for name, value in ODD.items() if isinstance(value, str | int | float)},
    "none": h5py.Empty("f"),
    "bytes": np.bytes_(b"\xff\xfe"),
    "texts": np.array(["loss", "loss"], h5py.string_dtype()),
    "numbers": np.arange(5),
    "square": np.ones((2, 2)),
    "pair": np.zeros((), [("a", int), ("b", float)]),
    "whole": np.int64(3),
}


def _unwritten(parent: h5py.Group, name: str) -> None:
    parent.create_dataset(name, (10**12,), float, chunks=(10**6,))


def _outside(parent: h5py.Group, name: str) -> None:
    parent.create_dataset(name, (4,), float, external=[(__file__, 0, 32)])


def _virtual(parent: h5py.Group, name: str) -> None:
    layout = h5py.VirtualLayout((4,), float)
    layout[:] = h5py.VirtualSource(__file__, "x", (4,))
    parent.create_virtual_dataset(name, layout)


def _object(**options: Any) -> Callable[[h5py.Group, str], None]:
    return lambda parent, name: parent.create_dataset(name, **options) and None


OBJECTS: dict[str, Callable[[h5py.Group, str], Any]] = {
    "nothing": lambda parent, name: None,
    "group": lambda parent, name: parent.create_group(name),
    "itself": lambda parent, name: parent.__setitem__(name, parent.file["/"]),
    "soft link": lambda parent, name: parent.__setitem__(name, h5py.SoftLink("/best")),
    "circle": lambda parent, name: parent.__setitem__(name, h5py.SoftLink(f"{parent.name}/{name}")),
    "link outside": lambda parent, name: parent.__setitem__(name, h5py.ExternalLink(__file__, "/")),
    "type": lambda parent, name: parent.__setitem__(name, np.dtype("f8")),
    "unwritten": _unwritten,
    "outside": _outside,
    "virtual": _virtual,
    "text": _object(data="text"),
    "texts": _object(data=np.array(["a", "b"], h5py.string_dtype())),
    "number": _object(data=3.0),
    "short": _object(data=np.zeros(1)),
    "empty": _object(data=np.zeros(0)),
    "square": _object(data=np.zeros((3, 3))),
    "nan": _object(data=np.full(4, np.nan)),
    "whole": _object(data=np.arange(4)),
    "negative": _object(data=np.full(4, -(2**40))),
    "complex": _object(data=np.zeros(4, complex)),
    "logical": _object(data=np.zeros(4, bool)),
    "half": _object(data=np.zeros(4, np.float16)),
    "swapped": _object(data=np.zeros(4, ">f8")),
    "no data": _object(data=h5py.Empty("f8")),
    "pairs": _object(data=np.zeros(4, [("a", int)])),
    "ragged": _object(shape=(2,), dtype=h5py.vlen_dtype(float)),
    "pointers": _object(shape=(2,), dtype=h5py.ref_dtype),
    "filter": _object(data=np.zeros(400), compression="lzf"),
}

HDF5 = st.one_of(
    st.tuples(st.just("attribute"), PLACE, st.sampled_from(sorted(ATTRIBUTES))),
    st.tuples(st.just("no attribute"), PLACE, st.just("")),
    st.tuples(st.just("object"), PLACE, st.sampled_from(sorted(OBJECTS))),
    st.tuples(st.just("config"), PLACE, st.sampled_from(sorted(ODD))),
)


def changed_hdf5(content: bytes, change: tuple[str, float, str]) -> bytes:
    """Change an attribute, an object or a value of the configuration of a result file."""
    how, share, odd = change
    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        if how == "config":
            file.attrs["config"] = changed_json(file.attrs["config"], (share, odd))
        elif how == "object":
            places: list[str] = []
            file.visit(places.append)
            place = places[int(share * len(places))]
            parent, _, name = place.rpartition("/")
            del file[place]
            OBJECTS[odd](file[parent or "/"], name)
        else:
            groups = ["/", *(name for name, item in file.items() if isinstance(item, h5py.Group))]
            names = [(group, name) for group in groups for name in file[group].attrs]
            group, name = names[int(share * len(names))]
            del file[group].attrs[name]
            if how == "attribute":
                file[group].attrs[name] = ATTRIBUTES[odd]
    return buffer.getvalue()


# ------------------------------------------------------------------------------------------------ arrays

ARRAYS: dict[str, Any] = {
    "nothing": np.zeros(0),
    "number": np.float64(3),
    "nan": np.full((16, 16, 16), np.nan),
    "huge": np.full((16, 16, 16), 1e308),
    "negative": np.full((16, 16, 16), -1.0),
    "whole": np.full((16, 16, 16), -(2**63)),
    "unsigned": np.full((16, 16, 16), 2**64 - 1, np.uint64),
    "complex": np.zeros((16, 16, 16), complex),
    "logical": np.zeros((16, 16, 16), bool),
    "columns": np.zeros((16, 16, 16), order="F"),
    "swapped": np.zeros((16, 16, 16), ">f4"),
    "objects": np.array([{}, []], dtype=object),
    "texts": np.array(["a", "b"]),
    "bytes": np.array([b"a"]),
    "dates": np.array(["2020-01-01"], "M8[D]"),
    "pairs": np.zeros(3, [("a", int)]),
    "other": np.zeros((17, 3)),
}

HEADERS = {
    "shape": (b"(16, 16, 16)", b"(99999999999999, 16)"),
    "sign": (b"(16, 16, 16)", b"(-16,-16, 16)"),
    "word": (b"'<f8'", b"'|O' "),
    "code": (b"'<f8'", b"exit()"),
    "nested": (b"(16, 16, 16)", b"(" * 500),
    "open": (b"}", b"'''"),
    "version": (b"NUMPY\x01", b"NUMPY\x03"),
    "length": (b"\x00v\x00", b"\x00\xff\xff"),
}

NPY = st.one_of(
    st.sampled_from(sorted(ARRAYS)).map(lambda name: ("array", name)),
    st.sampled_from(sorted(HEADERS)).map(lambda name: ("header", name)),
)


def changed_npy(content: bytes, change: tuple[str, str]) -> bytes:
    """Put another array into a file, or another header before it."""
    how, name = change
    if how == "header":
        return content.replace(*HEADERS[name], 1)
    return npy(ARRAYS[name])


def npy(array: Any) -> bytes:
    """Return an array as the bytes of a ``.npy`` file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


# ------------------------------------------------------------------------------------------------ archives

MEMBERS = ("gone", "twice", "up", "root", "bomb", "zip", "folder", "empty", "packed", "text")


XZ = b"\xfd7zXZ"
"""How an archive begins."""


def changed_zip(content: bytes, change: tuple[float, str]) -> bytes:
    """Change a member of a zip file, or what its name is."""
    share, how = change
    members = members_of(content)
    at = int(share * len(members))
    name, own = members.pop(at)
    new = {
        "gone": [],
        "twice": [(name, own), (name, own[::-1])],
        "up": [(f"../{name}", own)],
        "root": [(f"/{name}", own)],
        "bomb": [(name, bytes(40_000_000))],
        "zip": [(name, content)],
        "folder": [(f"{name}/", b"")],
        "empty": [(name, b"")],
        "packed": [(name, own)],
        "text": [(name, b"hello")],
    }[how]
    changed = zipped(
        [*members[:at], *new, *members[at:]], zipfile.ZIP_LZMA if how == "packed" else zipfile.ZIP_DEFLATED
    )
    return packed_as(content, changed)


def zipped(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return members as the bytes of a zip file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as archive:
        # Of names that are there twice.
        warnings.simplefilter("ignore")
        for name, own in members:
            archive.writestr(name, own)
    return buffer.getvalue()


def changed_member(content: bytes, change: tuple[float, Callable[[bytes], bytes]]) -> bytes:
    """Change what a member of a zip file holds."""
    share, edit = change
    members = members_of(content)
    at = int(share * len(members))
    members[at] = members[at][0], edit(members[at][1])
    return packed_as(content, zipped(members))


def members_of(content: bytes) -> list[tuple[str, bytes]]:
    """Return the members of a zip file, or of an archive, which is one that xz has packed."""
    if content.startswith(XZ):
        content = lzma.decompress(content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]


def packed_as(content: bytes, changed: bytes) -> bytes:
    """Pack a changed zip file as the one before was."""
    return lzma.compress(changed) if content.startswith(XZ) else changed


def changed_header(content: bytes, change: tuple[float, str]) -> bytes:
    """Change a value of the header of a policy."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = str(np.load(io.BytesIO(members["header.npy"])))
    members["header.npy"] = npy(np.array(changed_json(header, change)))
    return zipped(list(members.items()))


ODD_JSON = st.tuples(PLACE, st.sampled_from(sorted(ODD)))
ZIP = st.tuples(PLACE, st.sampled_from(MEMBERS))

# ------------------------------------------------------------------------------------------------ YAML

WORDS = ("!!python/object/apply:os.abort []", "!!binary aGk=", "*nowhere", "${nowhere}", "${.}")
WORDS += (
    "[",
    "{a: b",
    "- 1",
    "'",
    "|",
    "~",
    ".nan",
    "1e999",
    "0x",
    "2020-01-01",
    "? x",
    "%YAML 9",
    "\t",
    "\x07",
)


def changed_words(content: bytes, change: tuple[float, str]) -> bytes:
    """Put something odd in the place of a value in YAML."""
    share, odd = change
    lines = content.decode().splitlines()
    at = int(share * len(lines))
    key, colon, _ = lines[at].partition(":")
    lines[at] = f"{key}{colon} {odd}"
    return "\n".join(lines).encode()


# ------------------------------------------------------------------------------------------------ the fuzzer


def edits(kind: str) -> st.SearchStrategy[Callable[[bytes], bytes]]:
    """Return what changes the bytes of a file of a kind."""

    def of(change: Callable[[bytes, Any], bytes], how: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
        return how.map(lambda drawn: lambda content: change(content, drawn))

    by_bytes, hdf5, arrays = of(changed_bytes, BYTES), of(changed_hdf5, HDF5), of(changed_npy, NPY)
    members = of(changed_zip, ZIP)
    own = {
        "result": [hdf5],
        "partial": [hdf5],
        "archive": [members, of(changed_member, st.tuples(PLACE, st.one_of(by_bytes, hdf5)))],
        "target": [arrays],
        "policy": [
            members,
            of(changed_header, ODD_JSON),
            of(changed_member, st.tuples(PLACE, st.one_of(by_bytes, arrays))),
        ],
        "task": [of(changed_words, st.tuples(PLACE, st.sampled_from(WORDS)))],
        "mesh": [],
    }[kind]
    return st.one_of(by_bytes, *own, *own)


def fuzz(kind: str, original: Path, folder: Path, count: int) -> None:
    """Read files of a kind, each changed in one way."""
    reading, content = KINDS[kind][1], original.read_bytes()
    path = folder / original.relative_to(original.parents[1])
    path.parent.mkdir(parents=True)

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(edits(kind))
    def one(edit: Callable[[bytes], bytes]) -> None:
        path.write_bytes(edit(content))
        answered(lambda: reading(path))

    one()


@pytest.mark.parametrize("kind", KINDS)
def test_some_changes(sound: dict[str, Path], tmp_path: Path, kind: str) -> None:
    fuzz(kind, sound[kind], tmp_path, CASES["few"])


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_many_changes(sound: dict[str, Path], tmp_path: Path, kind: str) -> None:
    fuzz(kind, sound[kind], tmp_path, CASES["many"])


# ------------------------------------------------------------------------------------------------ every one


EVERY = {
    "hdf5 objects": (
        "result",
        changed_hdf5,
        [("object", s, odd) for odd in OBJECTS for s in (0.0, 0.5, 0.9)],
    ),
    "hdf5 attributes": (
        "result",
        changed_hdf5,
        [("attribute", s / 8, odd) for odd in ATTRIBUTES for s in range(8)],
    ),
    "arrays": ("target", changed_npy, [("array", odd) for odd in ARRAYS if odd != "columns"]),
    "configurations": (
        "result",
        changed_hdf5,
        [("config", s / 31, odd) for odd in ("nothing", "list") for s in range(31)],
    ),
    "headers": ("target", changed_npy, [("header", odd) for odd in HEADERS]),
}


@pytest.mark.parametrize("which", EVERY)
def test_every_odd_part_is_answered(sound: dict[str, Path], tmp_path: Path, which: str) -> None:
    kind, change, cases = EVERY[which]
    original = sound[kind]
    path = tmp_path / original.relative_to(original.parents[1])
    path.parent.mkdir(parents=True)
    for case in cases:
        path.write_bytes(change(original.read_bytes(), case))
        said = answered(lambda: KINDS[kind][1](path))
        assert kind != "target" or (said is not None and "Torus3D-v1.npy" in said), case

"""Pages of the documentation, and the files of their examples."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

__all__ = ["ROOT", "blocks", "star_files"]

ROOT = Path(__file__).resolve().parents[1]


def blocks(page: str, language: str) -> list[str]:
    """Code blocks of a page in ``docs``."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.fixture(scope="module")
def star_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that the script of docs/own_shapes.md writes."""
    folder = tmp_path_factory.mktemp("star")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        runpy.run_path(str(ROOT / "examples" / "own_shapes" / "star.py"))
    return folder

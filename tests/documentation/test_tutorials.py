"""The tutorials run from end to end, as they stand, and their pictures show something."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
WRITTEN = {
    "artist": {"before.png", "map.npz", "dressed.glb", "dressed.png", "confidence.png", "check.glb"},
    "anatomist": {"landmarks.csv", "map.npz", "match.png", "child.csv", "landmarks.png", "registered.ply"},
    "researcher": {"map.npz"},
}


def script(page: str, language: str) -> str:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return "".join(re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


def run(words: list[str], source: str, folder: Path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        words, input=source, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("page", WRITTEN)
def test_a_tutorial_runs_from_end_to_end(page: str, tmp_path: Path) -> None:
    (tmp_path / "templates").symlink_to(ROOT / "templates")
    run(["bash", "-e"], script(page, "bash"), tmp_path)
    run([sys.executable, "-W", "error", "-"], script(page, "python"), tmp_path)
    assert WRITTEN[page] <= {path.name for path in tmp_path.iterdir()}
    for picture in tmp_path.glob("*.png"):
        pixels = np.asarray(Image.open(picture).convert("RGB"))
        drawn = (np.abs(pixels.astype(int) - pixels[0, 0]).max(axis=2) > 40).mean(axis=0) > 0.02
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 500
        assert drawn[: len(drawn) // 2].any()  # both shapes are there
        assert drawn[len(drawn) // 2 :].any()

"""Collections that lie where a URL says."""

import shutil
from pathlib import Path

import pytest

import meshmatch
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError

pytest.importorskip("fsspec")
SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


def test_files_at_a_url(tmp_path: Path) -> None:
    store = Store.of(f"file://{tmp_path}/deep")
    assert store.remote and store.names() == [] and not store.exists("a/b.txt")
    with store.writing("a/b.txt") as path:
        path.write_text("words")
    with store.reading("a/b.txt") as path:
        assert path.read_text() == "words"
    (tmp_path / "deep" / ".hidden").write_text("")
    assert (
        store.exists("a/b.txt")
        and store.exists("a")
        and store.names() == ["a/b.txt"] == Store.of(tmp_path / "deep").names()
    )
    store.remove("a")
    store.remove("a")
    assert store.names() == []
    with pytest.raises(InputError, match="cannot read"), store.reading("a/b.txt"):
        pass
    with pytest.raises(InputError, match="cannot reach"):
        Store.of("nowhere://bucket").names()


def test_what_breaks_while_it_is_written_is_not_sent(tmp_path: Path) -> None:
    store = Store.of(f"file://{tmp_path}")
    with pytest.raises(RuntimeError), store.writing("half.txt") as path:
        path.write_text("ha")
        raise RuntimeError
    assert store.names() == []


def test_a_collection_at_a_url_is_that_of_a_folder(tmp_path: Path) -> None:
    shapes = tmp_path / "shapes"
    shapes.mkdir()
    for name in ("climber", "dancer"):
        shutil.copy(SAMPLES / f"{name}.ply", shapes)
    far = meshmatch.Collection(f"file://{tmp_path}/far", workers=1)
    made = far.fit(f"file://{shapes}", model="human")
    assert [record.verdict for record in made.records] == ["good", "good"]
    near = meshmatch.Collection(tmp_path / "near", workers=1)
    near.fit(shapes, model="human")
    for name in far.names:
        files = [tmp_path / place / "fits" / f"{name}.safetensors" for place in ("far", "near")]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert not (tmp_path / "far" / "agreeing").exists()
    assert far.save_maps(f"file://{tmp_path}/maps") == 2
    found = meshmatch.load_map(tmp_path / "maps" / "climber" / "dancer.npz", SAMPLES / "climber.ply")
    assert found.verdict == "good"
    assert far.fit(f"file://{shapes}").agreed == 2  # nothing is left to do

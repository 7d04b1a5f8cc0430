"""Tests of model files, which are untrusted: they must not run code, crash or hang."""

import errno
import io
import json
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapecat.errors import ModelError, OutputError
from shapecat.learning import Categorizer, load_model, model_file, save_model
from shapecat.learning.categorizer import parts_of
from shapecat.learning.features import Standardisation
from shapecat.learning.forest import FlatForest


def tiny() -> Categorizer:
    """Return a small model of two trees and three features."""
    forest = FlatForest(
        np.array([0, 3]),
        np.array([1, 0, 0, 2, 0, 0]),
        np.array([0.5, 0, 0, -1, 0, 0]),
        np.array([1, 0, 0, 4, 0, 0]),
    )
    standardisation = Standardisation(mean=np.zeros(3), inverse_scale=np.ones(3))
    return Categorizer(
        categories=("cup", "can"),
        descriptor_names=("a", "b", "c"),
        standardisation=standardisation,
        forest=forest,
        leaf_values=np.array([[1, 0], [0, 1], [0.5, 0], [0, 0.5]]),
        linear=np.zeros((2, 3)),
        bias=np.array([0.0, 0.1]),
        temperature=0.7,
        threshold=-1.5,
        known_descriptors=np.array([[0, 0, 0], [0, 1, 0]]),
        known_category=np.array([0, 1]),
        notes={"seed": 3},
    )


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "model.npz"
    save_model(path, tiny())
    return path


def rewrite(path: Path, change: Callable[[dict[str, bytes]], object]) -> None:
    """Apply ``change`` to the members of a model file: a dict from name to content."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy(value: object, dtype: str) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(value, dtype))
    return stream.getvalue()


def test_saved_model_is_loaded_unchanged(saved: Path) -> None:
    before, after = tiny(), load_model(saved)

    for name, value in parts_of(before).items():
        assert np.array_equal(parts_of(after)[name], value), name
    assert after.model_id == before.model_id
    x = np.array([[0.1, 0.7, -2.0]], np.float32)
    assert np.array_equal(after.predict(x).posteriors, before.predict(x).posteriors)


def test_model_file_is_reproducible(saved: Path, tmp_path: Path) -> None:
    """Otherwise `make model` would change the repository each time."""
    second = tmp_path / "again.npz"
    save_model(second, load_model(saved))

    assert second.read_bytes() == saved.read_bytes()


@pytest.mark.parametrize("limit", ["_LARGEST_FILE", "_LARGEST_CONTENT"])
def test_too_large_models_replace_nothing(
    saved: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    """A model that the reader refuses for its size would replace one that works."""
    before = saved.read_bytes()
    monkeypatch.setattr(model_file, limit, 1000)

    with pytest.raises(OutputError, match="the model is too large"):
        save_model(saved, tiny())
    assert saved.read_bytes() == before


def test_model_id_depends_on_content(saved: Path) -> None:
    def raise_temperature(members: dict[str, bytes]) -> None:
        header = json.loads(members["header.json"])
        header["temperature"] = 0.8
        members["header.json"] = json.dumps(header).encode()

    rewrite(saved, raise_temperature)

    assert load_model(saved).model_id != tiny().model_id


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not an intact"),
        (b"not a model at all" * 100, "not an intact"),
        (b"PK\x03\x04" + bytes(60), "not an intact"),
    ],
)
def test_other_files_raise_with_path_and_reason(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(content)

    with pytest.raises(ModelError, match=reason) as caught:
        load_model(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_raises_model_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot read the model: No such file"):
        load_model(tmp_path / "absent.npz")


def test_other_npz_file_is_rejected(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", points=np.zeros(3))

    with pytest.raises(ModelError, match=r"no header\.json"):
        load_model(tmp_path / "x.npz")


def edit_header(**changes: object) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        header = json.loads(members["header.json"]) | changes
        members["header.json"] = json.dumps(header).encode()

    return change


def put(name: str, value: object, dtype: str) -> Callable[[dict[str, bytes]], None]:
    return lambda members: members.update({f"{name}.npy": npy(value, dtype)})


def break_header(members: dict[str, bytes]) -> None:
    members["leaf_values.npy"] = members["leaf_values.npy"].replace(b"}", b" ", 1)


_HOSTILE = {
    "older": (edit_header(version=2), "reads version 3; make one with `shapecat learn`"),
    "newer": (edit_header(version=4), "version 4"),
    "other format": (edit_header(format="x"), "does not say"),
    "header is a list": (lambda m: m.update({"header.json": b"[]"}), "does not say"),
    "header is deep": (lambda m: m.update({"header.json": b"[" * 10**6}), "not a usable"),
    "header is no text": (lambda m: m.update({"header.json": b"\xff\xfe{}"}), "not a usable"),
    "a huge number": (edit_header(temperature=10**400), "not a usable"),
    "not a number": (edit_header(temperature=float("nan")), "numbers"),
    "temperature near 0": (edit_header(temperature=1e-300), "numbers"),
    "a category twice": (edit_header(categories=["cup", "cup"]), "category names"),
    "a category without a name": (edit_header(categories=["cup", ""]), "category names"),
    "a name of two lines": (edit_header(categories=["cup", "a\nb"]), "category names"),
    "a name that is no Unicode": (edit_header(categories=["cup", "\ud800"]), "category names"),
    "unknown as a category": (edit_header(categories=["cup", "unknown"]), "category names"),
    "a category too many": (edit_header(categories=["cup", "can", "box"]), "categories"),
    "two categories missing": (edit_header(categories=[]), "categories, category names"),
    "a name is no text": (edit_header(categories=["cup", 3]), "wrong type"),
    "an array missing": (lambda m: m.pop("leaf_values.npy"), "no leaf_values"),
    "an array without header": (break_header, "header of an array is damaged"),
    "of another type": (put("leaf_values", np.zeros((4, 2)), "f8"), "wrong type"),
    "of objects": (put("leaf_values", np.zeros((4, 2)), "c8"), "differs from its header"),
    "a loop": (put("forest.left", [1, 0, 0, 3, 0, 0], "u4"), "damaged"),
    "a child behind the end": (put("forest.left", [1, 0, 0, 4, 0, 5], "u4"), "damaged"),
    "a root behind the end": (put("forest.roots", [0, 99], "u4"), "damaged"),
    "no trees": (put("forest.roots", [], "u4"), "damaged"),
    "a feature too many": (put("forest.feature", [9, 0, 0, 2, 0, 0], "u2"), "features"),
    "a component too many": (edit_header(descriptor_names=["a", "b", "c", "d"]), "descriptor"),
    "a component missing": (edit_header(descriptor_names=["a", "b"]), "descriptor"),
    "a mean of NaN": (put("standardisation.mean", [0, np.nan, 0], "f4"), "not finite"),
    "no threshold": (edit_header(threshold=float("inf")), "numbers"),
    "two learners too many": (put("bias", [0.0, 0.1, 0.2, 0.3], "f8"), "not a usable"),
    "infinite leaf values": (put("leaf_values", np.full((4, 2), np.inf), "f2"), "numbers"),
    "known views of NaN": (put("known_descriptors", np.full((2, 3), np.nan), "f2"), "numbers"),
    "an unknown category": (put("known_category", [0, 7], "u1"), "known views"),
}


@pytest.mark.parametrize("case", _HOSTILE)
def test_hostile_models_are_rejected(saved: Path, case: str) -> None:
    """With an unchecked index, the compiled trees would crash or never end."""
    change, reason = _HOSTILE[case]
    rewrite(saved, change)

    with pytest.raises(ModelError, match=reason) as caught:
        load_model(saved)
    assert "\n" not in str(caught.value)


def test_claimed_array_size_is_not_allocated(saved: Path) -> None:
    """A header of 100 bytes must not make the reader allocate gigabytes."""
    real = npy(np.zeros((4, 2)), "f2")
    rewrite(
        saved,
        lambda m: m.update(
            {"leaf_values.npy": real.replace(b"(4, 2), }    ", b"(400000000, 2), }")}
        ),
    )
    tracemalloc.start()
    try:
        with pytest.raises(ModelError, match="size of an array differs"):
            load_model(saved)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert peak < 1e6


def test_zip_bomb_is_not_unpacked(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test lowers the limit, since packing more than 128 MB would take a second."""
    assert model_file._LARGEST_CONTENT == 128 << 20
    monkeypatch.setattr(model_file, "_LARGEST_CONTENT", 8 << 20)
    content = bytes(9 << 20)
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("leaf_values.npy", content)

    with pytest.raises(ModelError, match="unpacks to more than"):
        load_model(saved)


def test_damaged_file_raises_or_still_predicts(saved: Path) -> None:
    """Damage anywhere in the file must not crash the reader, or the prediction later."""
    content = saved.read_bytes()
    rng = np.random.default_rng(0)
    x = np.zeros((1, 3), np.float32)
    for position in rng.integers(0, len(content), 300):
        damaged = bytearray(content)
        damaged[position] ^= int(rng.integers(1, 256))
        saved.write_bytes(damaged)
        try:
            model = load_model(saved)
        except ModelError:
            continue
        assert model.predict(x).posteriors.shape == (1, 2)


def test_pickles_are_never_loaded(saved: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, np.array([{}], object), allow_pickle=True)
    rewrite(saved, lambda m: m.update({"leaf_values.npy": stream.getvalue()}))

    with pytest.raises(ModelError, match="differs from its header"):
        load_model(saved)


def test_descriptor_of_other_version_is_rejected() -> None:
    with pytest.raises(ModelError, match="a different descriptor"):
        tiny().require_descriptor(("a", "b", "d"))
    tiny().require_descriptor(("a", "b", "c"))


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(OutputError, match="cannot be written"):
        save_model(tmp_path / "file" / "model.npz", tiny())


def test_only_models_are_replaced(saved: Path, tmp_path: Path) -> None:
    """A mistyped --out must not destroy a recording, or a data set in another archive."""
    recording, archive = tmp_path / "lab.mcap", tmp_path / "views.npz"
    recording.write_bytes(b"years of work")
    np.savez(archive, points=np.zeros(3))
    for path in (recording, archive):
        before = path.read_bytes()
        with pytest.raises(OutputError, match="exists and is not a model"):
            save_model(path, tiny())
        assert path.read_bytes() == before
    (tmp_path / "empty").touch()
    for path in (saved, tmp_path / "empty"):
        save_model(path, tiny())
        assert load_model(path).model_id == tiny().model_id


def test_failed_write_keeps_previous_model(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    monkeypatch.setattr("shapecat.system.files.flush", full_disk)
    with pytest.raises(OutputError, match="No space left"):
        save_model(saved, tiny())

    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def full_disk(path: Path) -> None:
    raise OSError(errno.ENOSPC, "No space left on device", path)

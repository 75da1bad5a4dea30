"""Labels of a run: made, listed, searched, taken out."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.app import cli
from swag_engine.base.errors import InputError
from swag_engine.experiments import label_run as semantics_run
from swag_engine.experiments.label_run import extract_run, label_run, search_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.rendering.model import cloud_from_checkpoint
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.semantics.assign import render_labels
from swag_engine.semantics.masks import MaskFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint, save_checkpoint

REEF = Path(__file__).resolve().parents[1] / "scenes" / "reef_wreck"
MASKS = REEF / "labels"
NAMES = ("open water", "sand", "rock", "wreck", "amphora", "coral", "sponge", "seagrass")


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the demo scene that stopped before its first step: one Gaussian a sparse point."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    scene = load_scene(REEF)
    cloud = gaussians_from_points(scene.points, 5000, 1, 0, np.array([0.1, 0.2, 0.3]))
    cloud.opacity_logits[:] = 3.0
    run = RunFolder(folder)
    run.write_config(scene.folder, TrainSettings(width=160), scene.up.tolist())
    tensors = {f"cloud.{name}": tensor for name, tensor in cloud.parameters().items()}
    save_checkpoint(folder, 0, tensors, {"iteration": 0, "seconds": 0.0, "dropout": 0.0, "medium": None, "guard": {}})
    write_ply(run.ply, cloud.to_splats())
    return folder


@pytest.fixture
def run(untouched: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(untouched, tmp_path / "run"))


@pytest.fixture(scope="module")
def labelled(untouched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(shutil.copytree(untouched, tmp_path_factory.mktemp("labelled") / "run"))
    stages = []
    label_run(folder, masks=MASKS, with_features=True, progress=lambda stage, part: stages.append((stage, part)))
    assert stages[-1] == ("Regions", 1.0) and len(stages) == 18  # training photographs alone
    return folder


def test_masks_become_labels_of_gaussians_in_every_file(untouched: Path, labelled: Path) -> None:
    table = json.loads((labelled / "labels.json").read_text())
    assert {entry["name"] for entry in table["labels"]} == set(NAMES)
    assert [entry["id"] for entry in table["labels"]] == list(range(1, 9))
    assert sum(entry["fraction"] for entry in table["labels"]) == pytest.approx(1, abs=1e-4)
    assert table["regions"] == "masks" and table["photographs"] == 18 and table["agreement"] > 0.7
    splats, before = read_ply(labelled / "result.ply"), read_ply(untouched / "result.ply")
    for name in ("positions", "rotations", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(splats, name), getattr(before, name)), name
    numbers = splats.extras["label"]
    assert numbers.dtype == np.int32
    counts = {entry["id"]: entry["count"] for entry in table["labels"]} | {0: table["unlabelled"]}
    assert counts == {i: int((numbers == i).sum()) for i in range(9)}
    features = np.stack([splats.extras[f"feature_{i:02d}"] for i in range(32)], 1)
    lengths = np.linalg.norm(features, axis=1)
    assert np.allclose(lengths[lengths > 0], 1, atol=1e-5) and (lengths > 0).mean() > 0.6
    assert np.array_equal(read_glb(labelled / "result.glb").extras["label"], numbers)


def test_labels_are_those_of_the_truth_at_held_out_views(labelled: Path) -> None:
    """At sparse points, most of them near the edges of things; held-out photographs and masks were not used."""
    scene = load_scene(REEF)
    table = json.loads((labelled / "labels.json").read_text())["labels"]
    names = [""] + [entry["name"] for entry in table]
    splats = read_ply(labelled / "result.ply")
    right = total = 0
    for image in load_images(scene, [view for view in scene.views if view.name in ("reef_000.jpg", "reef_016.jpg")]):
        view = next(view for view in scene.views if view.name == image.camera.name)
        truth = {region.label: region.mask for region in MaskFolder(MASKS, scene).regions(image, [])}
        points = scene.points.positions[view.point_indices]
        seen = points @ image.camera.world_to_camera[:3, :3].T + image.camera.world_to_camera[:3, 3]
        pixels = np.floor((seen @ image.camera.K.T)[:, :2] / seen[:, 2:]).astype(int)
        order = {tuple(position): i for i, position in enumerate(splats.positions.round(4).tolist())}
        for point, (x, y) in zip(points.astype(np.float32).round(4).tolist(), pixels, strict=True):
            place = order.get(tuple(point))
            if place is not None and splats.extras["label"][place] and 0 <= x < 640 and 0 <= y < 360:
                total += 1
                right += truth[names[splats.extras["label"][place]]][y, x]
    assert total > 500 and right / total > 0.7, (right, total)


def test_search_finds_labels_by_name_and_says_when_it_cannot(labelled: Path, run: Path) -> None:
    numbers = read_ply(labelled / "result.ply").extras["label"]
    ids = {entry["name"]: entry["id"] for entry in json.loads((labelled / "labels.json").read_text())["labels"]}
    for words in ("Wreck", "the  wrecks"):
        found, names = search_run(labelled, words)
        assert names == ["wreck"] and found.dtype == np.float32 and found.min() >= -1 and found.max() <= 1 + 1e-5
        assert found[numbers == ids["wreck"]].mean() > found[numbers == ids["coral"]].mean() + 0.3
    with pytest.raises(InputError, match="Without CLIP only labels can be searched by name, and none is called eel"):
        search_run(labelled, "eel")
    with pytest.raises(InputError, match="One of the words to look for is empty"):
        search_run(labelled, " ")
    with pytest.raises(InputError, match="has no labels yet: make them with `label`"):
        search_run(run, "coral")


def test_words_that_no_label_is_called_are_compared_by_meaning(
    labelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Words:
        """Wreck and ship mean the direction in which the wreck's regions lie."""

        name, key = "clip", "words"

        def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
            raise AssertionError

        def words(self, words: list[str]) -> np.ndarray:
            return np.stack([meaning if word == "ship" else neutral for word in words])

    folder = Path(shutil.copytree(labelled, tmp_path / "run"))
    table = json.loads((folder / "labels.json").read_text())
    (folder / "labels.json").write_text(json.dumps(table | {"embedder": "clip"}))
    semantics = semantics_run.read_semantics(folder)
    wreck = next(entry["id"] for entry in table["labels"] if entry["name"] == "wreck")
    neutral = np.zeros(semantics.projection.matrix.shape[1], np.float32)
    meaning = semantics.prototypes[wreck - 1] @ semantics.projection.matrix
    monkeypatch.setattr(semantics_run, "make_embedder", lambda *arguments: Words())
    found, names = search_run(folder, "ship")
    by_name, _ = search_run(folder, "wreck")
    assert names == [] and np.allclose(found, by_name, atol=1e-4)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_one_label_is_taken_out(labelled: Path, tmp_path: Path, suffix: str) -> None:
    splats = read_ply(labelled / "result.ply")
    table = json.loads((labelled / "labels.json").read_text())["labels"]
    coral = next(entry for entry in table if entry["name"] == "coral")
    for wanted in ("Coral", str(coral["id"])):
        out = tmp_path / f"part{suffix}"
        assert extract_run(labelled, wanted, out) == coral["count"]
        part = read_ply(out) if suffix == ".ply" else read_glb(out)
        assert len(part) == coral["count"] and (part.extras["label"] == coral["id"]).all()
        assert np.allclose(
            np.sort(part.opacities), np.sort(splats.opacities[splats.extras["label"] == coral["id"]]), atol=1e-4
        )
    with pytest.raises(InputError, match="There is no label named kraken; there are .*wreck"):
        extract_run(labelled, "kraken", tmp_path / f"no{suffix}")
    with pytest.raises(InputError, match="part.obj is not a splat file"):
        extract_run(labelled, "coral", tmp_path / "part.obj")


def test_labels_without_masks_or_words_come_from_saliency(run: Path) -> None:
    assert label_run(run)["regions"] == "masks"  # the demo scene has some in its folder labels
    made = label_run(run, provider="saliency")
    assert made["regions"] == "saliency" and made["embedder"] == "color and texture"
    names = [entry["name"] for entry in made["labels"]]
    assert "open water" in names and 2 <= len(names) <= 9
    again = label_run(run, provider="saliency")  # over its own result, from the cache
    assert again == made
    assert not any(name.startswith("feature_") for name in read_ply(run / "result.ply").extras)
    with pytest.raises(InputError, match="saliency cannot look for words"):
        label_run(run, ["coral"], provider="saliency")


def test_what_cannot_be_labelled_leaves_the_run_as_it_was(run: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    for arguments, message in (
        ({"words": [""]}, "One of the words to look for is empty"),
        ({"masks": tmp_path / "absent"}, "There is no folder"),
        ({"words": ["eel"], "masks": MASKS}, "found no region of eel in any of the 18 images"),
        ({"words": ["coral"]}, "The network bert-vocabulary .* is not on this machine: get it .*vocab.txt"),
    ):
        with pytest.raises(InputError, match=message):
            label_run(run, **arguments)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before
    write_ply(run / "result.ply", read_ply(run / "result.ply").subset(np.arange(10)))
    with pytest.raises(InputError, match="holds 10 splats and the run's checkpoint"):
        label_run(run, masks=MASKS)
    with pytest.raises(InputError, match="is not a training run"):
        label_run(tmp_path)


def test_a_damaged_label_file_is_named(labelled: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(labelled, tmp_path / "run"))
    (folder / "semantics.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match="semantics.safetensors cannot be read"):
        search_run(folder, "coral")
    (folder / "labels.json").write_text('{"labels": [{"id": 1}]}')
    with pytest.raises(InputError, match="labels.json does not list labels"):
        extract_run(folder, "coral", tmp_path / "a.ply")


def test_the_truth_of_the_demo_scene_is_where_its_surfaces_are() -> None:
    """Labels were rendered apart from the photographs: open water is where there is no range."""
    assert (MASKS / "labels.txt").read_text().split("\n")[:8] == list(NAMES)
    assert len(list(MASKS.glob("*.png"))) == 24
    for path in sorted((REEF / "range").iterdir()):
        water = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) == 0
        labels = cv2.imread(str(MASKS / path.name), cv2.IMREAD_UNCHANGED)
        assert labels.shape == water.shape and labels.min() == 1 and labels.max() <= 8
        assert ((labels == 1) == water).mean() > 0.997


def test_rendering_the_labels_of_a_run_is_right_where_it_is_covered(labelled: Path) -> None:
    scene = load_scene(REEF)
    loaded = load_checkpoint(labelled)
    assert loaded is not None
    cloud = cloud_from_checkpoint(loaded[0])
    table = json.loads((labelled / "labels.json").read_text())["labels"]
    image = load_images(scene, scene.views[:1], 160)[0]
    numbers = torch.from_numpy(read_ply(labelled / "result.ply").extras["label"].astype(np.int64))
    shown = render_labels(cloud, numbers, len(table), image.camera)
    truth = np.zeros(shown.shape, int)
    for region in MaskFolder(MASKS, scene).regions(image, []):
        truth[region.mask] = next(entry["id"] for entry in table if entry["name"] == region.label)
    covered = shown > 0
    assert covered.mean() > 0.1 and (shown == truth)[covered].mean() > 0.6


# The doors ------------------------------------------------------------------------------------------------------------


def test_the_command_line_labels_searches_and_takes_out(
    untouched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(*arguments: object) -> SimpleNamespace:
        capsys.readouterr()
        code = cli.main([*map(str, arguments), "--json"])
        printed = capsys.readouterr()
        return SimpleNamespace(returncode=code, stdout=printed.out, stderr=printed.err)

    folder = shutil.copytree(untouched, tmp_path / "run")
    made = command("label", folder, "--masks", MASKS)
    assert made.returncode == 0, made.stderr
    document = json.loads(made.stdout)
    assert {entry["name"] for entry in document["labels"]} == set(NAMES)
    found = command("search", folder, "wreck", "--out", tmp_path / "wreck.npy")
    assert found.returncode == 0 and json.loads(found.stdout)["labels"] == ["wreck"]
    similarity = np.load(tmp_path / "wreck.npy")
    labels = read_ply(folder / "result.ply").extras["label"]
    wreck = next(entry["id"] for entry in document["labels"] if entry["name"] == "wreck")
    assert len(similarity) == len(labels)
    assert similarity[labels == wreck].mean() > similarity[labels != wreck].mean() + 0.2
    taken = command("extract", folder, "--label", "wreck", "--out", tmp_path / "wreck.ply")
    assert taken.returncode == 0
    count = json.loads(taken.stdout)["gaussians"]
    assert count == (labels == wreck).sum() == len(read_ply(tmp_path / "wreck.ply"))
    missing = command("extract", folder, "--label", "submarine", "--out", tmp_path / "no.ply")
    assert missing.returncode == 2 and "submarine" in missing.stderr and not (tmp_path / "no.ply").exists()


def test_the_worker_labels_and_searches(run: Path, tmp_path: Path) -> None:
    label = {"request": "label", "run": str(run)}
    search = {"request": "search", "run": str(run), "words": "wreck", "path": str(tmp_path / "wreck.npy")}
    requests = [
        label | {"masks": str(tmp_path / "absent")},
        label | {"words": "coral,,"},
        label | {"masks": 3},
        label | {"masks": str(MASKS)},
        search,
        search | {"words": "submarine"},
    ]
    done = subprocess.run(
        [sys.executable, "-m", "swag_engine.app.worker"],
        input="".join(json.dumps(request) + "\n" for request in requests),
        capture_output=True,
        text=True,
        cwd=REEF.parents[2],
    )
    events = [json.loads(line) for line in done.stdout.splitlines()]
    *refused, made, found, unknown = [event for event in events if event["event"] != "progress"]
    assert all(event["kind"] == "input" for event in refused)
    for event, message in zip(refused, ("There is no folder", "One of the words", "which is not a path"), strict=True):
        assert message in event["message"]
    assert any(event["event"] == "progress" and event["stage"] == "Regions" for event in events)
    assert made["request"] == "label" and {entry["name"] for entry in made["labels"]} == set(NAMES)
    assert found["event"] == "result" and found["labels"] == ["wreck"]
    np.testing.assert_array_equal(np.load(found["path"]), search_run(run, "wreck")[0])
    assert unknown["event"] == "error" and unknown["kind"] == "input" and "submarine" in unknown["message"]

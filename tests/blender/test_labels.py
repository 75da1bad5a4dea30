"""Labels of splats in Blender: list, show, select, search, masks, separate, merge."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest


@pytest.fixture
def labels_folder(tmp_path):
    """A run folder whose labels.json names label 1 coral and label 2 wreck."""
    entries = [{"id": i, "name": name, "count": 1, "fraction": 0.1} for i, name in enumerate(("coral", "wreck"), 1)]
    (tmp_path / "labels.json").write_text(json.dumps({"labels": entries}))
    return tmp_path


def test_labels_are_listed_by_name_hidden_and_isolated(blender, labels_folder):
    blender.run("labels.list_and_hide", labels_folder)


def test_label_colors_tint_what_is_shown_and_not_the_splats(blender, labels_folder):
    blender.run("labels.tint", labels_folder)


def test_colors_that_are_not_certain_are_marked_in_proportion(blender, tmp_path):
    blender.run("labels.mark_uncertain", tmp_path)


def test_names_and_visibility_of_labels_are_saved_in_the_file(blender, labels_folder):
    blender.run("labels.save_and_open", labels_folder)


def test_selected_labels_become_masks_for_geometry_nodes(blender, labels_folder):
    blender.run("labels.select_and_keep_mask", labels_folder)


def test_merging_separated_splats_restores_the_object(blender, labels_folder):
    blender.run("labels.separate_and_merge", labels_folder)


def test_undo_restores_an_object_before_its_separation(blender, labels_folder):
    blender.run("labels.undo_separation", labels_folder)


def test_search_writes_similarity_and_the_threshold_changes_the_selection(blender, labels_folder):
    from safetensors.numpy import save_file

    random = np.random.default_rng(0)
    prototypes = np.eye(32, dtype=np.float32)[:2]
    features = prototypes[np.repeat([0, 1], [60, 40])] + 0.1 * random.normal(size=(100, 32)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    file = labels_folder / "semantics.safetensors"
    save_file({"features": features.astype(np.float32), "prototypes": prototypes}, file)
    np.save(labels_folder / "expected.npy", features @ prototypes[0])
    blender.run("labels.search", labels_folder, SWAG_ENGINE_PYTHON="/nowhere")


def test_splats_without_labels_are_refused_with_what_to_do(blender, tmp_path):
    blender.run("labels.refuse_without_labels", tmp_path)


@pytest.mark.main_version
def test_a_run_is_labelled_by_the_engine(blender, tiny_scene, finished_run, tmp_path):
    shutil.copytree(finished_run, tmp_path / "run")
    for name, columns in (("left", slice(0, 30)), ("right", slice(30, 64))):
        (tmp_path / "masks" / name).mkdir(parents=True)
        mask = np.zeros((48, 64), np.uint8)
        mask[:, columns] = 255
        for image in (tiny_scene / "images").iterdir():
            cv2.imwrite(str(tmp_path / "masks" / name / image.name), mask)
    blender.run("labels.label_a_run", tmp_path, SWAG_ENGINE_PYTHON=sys.executable)
    assert "Labelling: Regions" in blender.printed

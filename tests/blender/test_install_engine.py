"""Install Engine, Check Engine and Remove Engine in Blender's preferences, from a folder of wheels."""

import json

import pytest


@pytest.mark.parametrize("blender", ["4.5"], indirect=True)  # the wheels are for its Python
def test_the_engine_is_installed_from_wheels_checked_and_removed(blender, wheels):
    found = blender.run("install_engine.install_check_and_remove", wheels)
    assert "Allow online access" in found["offline"]
    assert found["look up"].endswith("0 MB of them are to be downloaded.")
    assert found["complete after look-up"] is False
    assert found["install"].startswith("The engine is installed: Python 3.11")
    assert found["complete"] and found["python"].startswith(str(blender.user))
    assert set(json.loads(found["doctor"])["packages"].values()).isdisjoint({None})
    assert found["check"].startswith("The engine is ready: torch ")
    assert found["exists after removal"] is False
    assert found["outcome after removal"] == ["", False]
    assert "press Install Engine" in found["check after removal"]


@pytest.mark.parametrize("blender", ["4.5", "5.3"], indirect=True)  # 5.2 has the Python of 5.3
def test_a_failed_installation_is_reported_in_one_sentence_and_logged(blender, tmp_path):
    (tmp_path / "empty").mkdir()
    found = blender.run("install_engine.install_from", tmp_path / "empty")
    assert "The engine could not be installed. There is no wheel of " in found["message"]
    assert "Traceback" not in blender.printed
    assert "Looking up the packages" in found["log"]
    assert found["complete"] is False
    assert "press Install Engine" in found["check"]


def test_an_environment_whose_python_is_gone_is_not_used(blender):
    assert blender.run("install_engine.complete_with_a_dead_link") is False


def test_an_environment_of_another_python_is_not_used(blender):
    assert blender.run("install_engine.complete_with_version", "") is True
    assert blender.run("install_engine.complete_with_version", "3.9.1") is False


def test_a_python_without_the_packages_is_refused_with_their_names(blender, tmp_path):
    bare = tmp_path / "python"
    bare.write_text('#!/bin/sh\nexec /usr/bin/env python3 -S "$@"\n')
    bare.chmod(0o755)
    assert "This Python lacks torch, numpy" in blender.run("install_engine.check", bare)


def test_a_download_larger_than_stated_is_confirmed_first(blender):
    found = blender.run("install_engine.install_where_only_cuda_is_found")
    assert "about 0.4 GB" in found["before"] and "CUDA" not in found["before"]
    assert "Nothing was downloaded" in found["message"] and "Downloads 2.9 GB" in found["message"]
    assert "cannot be reached" in found["after"] and "Downloads 2.9 GB" in found["after"]
    assert found["without CUDA"] == [True, False], "the second time it is wanted"


def test_the_package_index_and_the_nvidia_card_are_found_from_the_system(blender, tmp_path):
    found = blender.run("install_engine.cards", str(tmp_path))
    assert found == {
        "none": False, "/proc": True, "/dev": True, "control only": False, "wsl": True,
        "index without card": "cpu", "index with card": "", "index on macOS": "", "own index": "own",
    }  # fmt: skip

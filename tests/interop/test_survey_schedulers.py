"""What docs/surveys.md gives to other schedulers: Flamenco's job type in Node, and Slurm's script in a shell."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.interop.install import NODE

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "surveys.md").read_text(encoding="utf-8")
FLAMENCO = """
const made = [];
const author = {
    Task: (name, type) => ({name, type, commands: [], after: [],
        addCommand(command) { this.commands.push(command) }, addDependency(task) { this.after.push(task.name) }}),
    Command: (name, parameters) => ({name, parameters}),
};
const settings = {survey: "/shared/a survey", blocks: 12, python: "python"};
"""
"""A stand-in for the functions of Flamenco that job types call."""


def code(language: str, words: str) -> str:
    """Return the code of a language on the page that has some words in it."""
    return next(text for text in re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL) if words in text)


def test_flamenco_runs_each_block_after_the_coarse_model():
    compiled = "compileJob({settings, addTask: task => made.push(task)}); console.log(JSON.stringify(made));"
    script = FLAMENCO + code("javascript", "JOB_TYPE") + compiled
    answer = subprocess.run([NODE, "-"], input=script, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    tasks = json.loads(answer.stdout)
    assert [task["name"] for task in tasks] == ["coarse", *(f"B-{number:03d}" for number in range(1, 13))]
    assert [task["after"] for task in tasks] == [[], *[["coarse"]] * 12]
    command = tasks[12]["commands"][0]
    assert command["name"] == "exec" and command["parameters"] == {
        "exe": "python",
        "args": ["-m", "swag_engine", "survey", "block", "/shared/a survey", "--block", "B-012"],
    }


@pytest.mark.skipif(sys.platform == "win32", reason="a script for bash")
@pytest.mark.parametrize("task, block", [("", "coarse"), ("1", "B-001"), ("11", "B-011")])
def test_slurm_array_names_the_blocks(tmp_path, task, block):
    for number in range(1, 13):
        (tmp_path / "a survey" / "blocks" / f"B-{number:03d}").mkdir(parents=True)
    script = code("bash", "SLURM_ARRAY_TASK_ID").replace("exec python", 'exec echo "$OMP_NUM_THREADS"')
    environment = {"PATH": "/usr/bin:/bin", "SLURM_CPUS_PER_TASK": "8", "SLURM_ARRAY_TASK_ID": task}
    answer = subprocess.run(
        ["bash", "-s", "a survey"], input=script, cwd=tmp_path, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert answer.stdout == f"8 -m swag_engine survey block a survey --block {block}\n"

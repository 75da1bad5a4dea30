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
const settings = {survey: "/shared/a survey", blocks: 12, seams: "S-001-002 S-003-012", python: "python"};
"""
"""A stand-in for the functions of Flamenco that job types call."""


def code(language: str, words: str) -> str:
    """Return the code of a language on the page that has some words in it."""
    return next(text for text in re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL) if words in text)


def test_flamenco_runs_blocks_after_the_coarse_model_and_seams_after_their_blocks():
    compiled = "compileJob({settings, addTask: task => made.push(task)}); console.log(JSON.stringify(made));"
    script = FLAMENCO + code("javascript", "JOB_TYPE") + compiled
    answer = subprocess.run([NODE, "-"], input=script, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    tasks = json.loads(answer.stdout)
    blocks = [f"B-{number:03d}" for number in range(1, 13)]
    assert [task["name"] for task in tasks] == ["coarse", *blocks, "S-001-002", "S-003-012"]
    assert [task["after"] for task in tasks[:13]] == [[], *[["coarse"]] * 12]
    assert [task["after"] for task in tasks[13:]] == [["B-001", "B-002"], ["B-003", "B-012"]]
    command = tasks[12]["commands"][0]
    assert command["name"] == "exec" and command["parameters"] == {
        "exe": "python",
        "args": ["-m", "swag_engine", "survey", "block", "/shared/a survey", "--block", "B-012"],
    }


@pytest.mark.skipif(sys.platform == "win32", reason="a script for bash")
@pytest.mark.parametrize(
    "parts, task, block", [([], "", "coarse"), (["blocks"], "11", "B-011"), (["seams"], "1", "S-001-002")]
)
def test_slurm_arrays_name_blocks_and_seams(tmp_path, parts, task, block):
    for number in range(1, 13):
        (tmp_path / "a survey" / "blocks" / f"B-{number:03d}").mkdir(parents=True)
    (tmp_path / "a survey" / "seams" / "S-001-002").mkdir(parents=True)
    script = code("bash", "SLURM_ARRAY_TASK_ID").replace("exec swag", 'exec echo "$OMP_NUM_THREADS"')
    environment = {"PATH": "/usr/bin:/bin", "SLURM_CPUS_PER_TASK": "8", "SLURM_ARRAY_TASK_ID": task}
    answer = subprocess.run(
        ["bash", "-s", "a survey", *parts], input=script, cwd=tmp_path, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert answer.stdout == f"8 survey block a survey --block {block}\n"


@pytest.mark.skipif(sys.platform == "win32", reason="a script for bash")
def test_slurm_gets_blocks_after_the_coarse_model_and_seams_after_the_blocks(tmp_path):
    for name in ("blocks/B-001", "blocks/B-002", "seams/S-001-002"):
        (tmp_path / name).mkdir(parents=True)
    stand_in = 'sbatch() { echo "$@" >> calls.txt; wc -l < calls.txt; }\n'
    lines = code("bash", "--parsable").replace("/shared/survey", str(tmp_path))
    subprocess.run(["bash", "-e", "-c", stand_in + lines], cwd=tmp_path, check=True, capture_output=True)
    rest = f"survey.sbatch {tmp_path}"
    assert (tmp_path / "calls.txt").read_text().splitlines() == [
        f"--parsable {rest}",
        f"--parsable --dependency=afterok:1 --array=1-2 {rest} blocks",
        f"--dependency=afterok:2 --array=1-1 {rest} seams",
    ]

"""What is served over and beyond the trained region, in all manners and from anywhere, is verified by verify.py.

    .venv-verify/bin/python -m pytest tests/verify

A few hundred requests; tests/verify/README.md has the command for many.
"""

import json
import os
import subprocess
from pathlib import Path

import pytest

import verify

ROOT = Path(__file__).resolve().parents[2]
BINARIES = Path(os.environ.get("TCVAE_BIN_DIR", ROOT / "target" / "debug"))
ROBOT, TASK = ROOT / "config" / "robots" / "baxter.toml", ROOT / "config" / "tasks" / "pour.toml"
SLOW = """
[limits.left_s0]
velocity = 0.5
acceleration = 1.0
jerk = 10.0

[limits.left_w2]
acceleration = 2.0
"""


def asked(tmp_path, *options, robot=ROBOT):
    samples = tmp_path / "samples.jsonl"
    model = ROOT / "models" / "pouring.safetensors"
    command = [BINARIES / "tcvae", "check", model, "--robot", robot, "--samples", samples, "--json", *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout), samples


@pytest.mark.parametrize("options", [
    ["--count", "300"],
    ["--count", "200", "--beyond", "0.1", "--seed", "2"],
    ["--count", "150", "--from-anywhere", "--seed", "3"],
], ids=["region", "beyond", "from anywhere"])
def test_no_sample_violates_any_check(tmp_path, options):
    answer, samples = asked(tmp_path, *options)
    assert answer["violations"] == 0, answer["violated"]
    served = answer["served"] + answer["served_unfamiliar"]
    assert served >= (50 if "--beyond" in options else 140), answer
    assert answer["requests"] == served + sum(answer["refused"].values())
    assert verify.main([str(samples), "--robot", str(ROBOT), "--task", str(TASK)]) == 0


def test_limits_of_the_robots_file_hold(tmp_path):
    robot = tmp_path / "slow.toml"
    robot.write_text(ROBOT.read_text() + SLOW)
    answer, samples = asked(tmp_path, "--count", "60", "--from-anywhere", "--at-least", "0", robot=robot)
    assert answer["violations"] == 0 and answer["served"] >= 20, answer
    assert answer["worst"]["slowdown"] > 1.5
    assert verify.main([str(samples), "--robot", str(robot), "--task", str(TASK)]) == 0
    # The verifier does look at them: with tighter ones nothing passes.
    robot.write_text(ROBOT.read_text() + SLOW.replace("0.5", "0.05").replace("acceleration = 1.0", "acceleration = 0.1"))
    assert verify.main([str(samples), "--robot", str(robot), "--task", str(TASK)]) == 1

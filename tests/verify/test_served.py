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
CONFIG = ROOT / "config"
ROBOT, TASK = CONFIG / "robots" / "baxter.toml", CONFIG / "tasks" / "pour.toml"
OTHER_ARM = CONFIG / "robots" / "baxter-right.toml", CONFIG / "tasks" / "pour-right.toml"
SLOW = """
[limits.left_s0]
velocity = 0.5
acceleration = 1.0
jerk = 10.0

[limits.left_w2]
acceleration = 2.0
"""


def asked(tmp_path, *options, robot=ROBOT, cores=None):
    """What tcvae check answers, on so many cores, and the file of its samples."""
    samples = tmp_path / "samples.jsonl"
    model = ROOT / "models" / "pouring.safetensors"
    command = [BINARIES / "tcvae", "check", model, "--robot", robot, "--samples", samples, "--json", *options]
    done = subprocess.run(command, capture_output=True, text=True,
                          preexec_fn=cores and (lambda: os.sched_setaffinity(0, cores)))
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout), samples


@pytest.mark.parametrize("options", [
    ["--count", "300"],
    ["--count", "200", "--beyond", "0.1", "--seed", "2"],
    ["--count", "150", "--from-anywhere", "--seed", "3"],
    ["--count", "100", "--speed", "1.5", "--seed", "4"],
], ids=["region", "beyond", "from anywhere", "faster"])
@pytest.mark.parametrize("robot, task", [(ROBOT, TASK), OTHER_ARM], ids=["left", "right"])
def test_no_sample_violates_any_check(tmp_path, options, robot, task):
    answer, samples = asked(tmp_path, *options, robot=robot)
    assert answer["violations"] == 0, answer["violated"]
    served = answer["served"] + answer["served_unfamiliar"]
    assert served >= (50 if {"--beyond", "--speed"} & set(options) else 140), answer
    assert answer["requests"] == served + sum(answer["refused"].values())
    assert verify.main([str(samples), "--robot", str(robot), "--task", str(task)]) == 0


def test_the_same_seed_gives_the_same_bytes_on_one_core_and_on_all(tmp_path):
    def served(name, *options, **more):
        (tmp_path / name).mkdir()
        answer, samples = asked(tmp_path / name, "--count", "60", "--beyond", "0.05", *options, **more)
        answer.pop("latency_ms")
        return answer, samples.read_bytes()

    one = served("one", cores={min(os.sched_getaffinity(0))})
    assert one[0]["tries"]["most"] > 1
    assert one == served("all")
    assert one != served("other", "--seed", "2")


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

"""The golden messages are what this distro's rclpy writes."""

import importlib.util
from pathlib import Path

GOLDEN = Path(__file__).resolve().parents[1] / "golden"


def test_the_golden_messages_are_those_of_this_distro():
    spec = importlib.util.spec_from_file_location("golden_messages", GOLDEN / "messages.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    committed = (GOLDEN / "messages.json").read_text(encoding="utf-8")
    assert script.golden().splitlines() == committed.splitlines()

"""tcvae doctor beside real nodes: what is good is called good, and what keeps programs apart is found."""

import json
import os
import subprocess

from conftest import BINARIES, start_node
from geometry_msgs.msg import PointStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


def doctor(domain, *arguments, **environment):
    """Exit status and findings."""
    merged = os.environ | {"ROS_DOMAIN_ID": str(domain)} | environment
    merged.pop("LD_LIBRARY_PATH", None)
    done = subprocess.run([BINARIES / "tcvae", "doctor", "--json", *arguments], env=merged, text=True,
                          capture_output=True, timeout=60)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)["findings"]


def facts(findings, verdict):
    return "\n".join(f"{f['fact']} -> {f['next']}" for f in findings if f["verdict"] == verdict)


def test_a_healthy_graph_is_called_so(start, make_client, domain):
    start_node(start)
    make_client("somebody")
    status, findings = doctor(domain)
    assert (status, facts(findings, "bad")) == (0, "")
    good = facts(findings, "good")
    assert "two participants found each other" in good
    assert "/somebody" in good and "/tcvae" in good
    assert "1 program with FastRTPS, FastDDS / eProsima" in good and "1 program with RustDDS" in good
    assert "pairs of endpoints match" in good


def test_what_does_not_match_is_found_with_what_to_do(start, make_client, domain):
    start_node(start)
    client = make_client("somebody")
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    client.node.create_publisher(PointStamped, "/tcvae/source_cup", best_effort)
    client.node.create_publisher(String, "/tcvae/goal_pose", 10)
    status, findings = doctor(domain)
    assert status == 1
    bad = facts(findings, "bad")
    assert "/tcvae/source_cup does not match in reliability (best effort is offered, reliable requested)" in bad
    assert "publish with reliable reliability" in bad
    assert "/tcvae/goal_pose is published as std_msgs/msg/String and subscribed to as geometry_msgs/msg/PoseStamped" in bad


def test_those_in_another_domain_are_told_of(start, make_client, domain):
    make_client("somebody")
    other = domain - 1 if domain > 1 else domain + 1
    _, findings = doctor(other, "--wait", "1")
    told = facts(findings, "doubtful")
    assert f"nobody else is in domain {other}" in told
    assert f"of this machine are in domain {domain} -> if that is whom you look for: export ROS_DOMAIN_ID={domain}" in told


def test_an_environment_that_keeps_programs_apart_is_found(domain):
    status, findings = doctor(domain, "--wait", "0.5", ROS_AUTOMATIC_DISCOVERY_RANGE="OFF")
    assert status == 1 and "discovery is off" in facts(findings, "bad")
    status, findings = doctor(domain, "--wait", "0.5", ROS_DISCOVERY_SERVER="10.0.0.1:11811")
    assert status == 1 and "ROS_DISCOVERY_SERVER is 10.0.0.1:11811" in facts(findings, "bad")
    done = subprocess.run([BINARIES / "tcvae", "doctor"], env={"ROS_DOMAIN_ID": "300"}, capture_output=True, text=True)
    assert done.returncode == 2 and "from 0 to 232" in done.stderr

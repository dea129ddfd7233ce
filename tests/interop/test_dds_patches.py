"""Each patch under patches/, seen from rclpy.

The server is mostly tests/interop/server.rs: ros2-client on the patched rustdds and nothing else. Without
its patch each of these tests fails; the figures are in the patches' headers.
"""

import os
import signal
import statistics
import sys
from pathlib import Path

from conftest import Process, start_node, wait_until
from lifecycle_msgs.srv import GetState
from std_srvs.srv import Trigger
from tcvae_msgs.srv import SampleTrajectory
from user import User

SERVICE = "/dds_probe/points"


def start_server(start):
    server = start("examples/interop_server")
    server.wait_for("ready")
    return server


def assert_complete(response, points):
    (sample,) = response.samples
    trajectory = sample.joint_trajectory
    assert response.model_id == "dds_probe"
    assert list(trajectory.joint_names) == [f"joint_{joint}" for joint in range(7)]
    assert len(trajectory.points) == points
    for index, point in enumerate(trajectory.points):
        expected = [index + joint / 8 for joint in range(7)]
        assert list(point.positions) == expected
        assert list(point.velocities) == [-value for value in expected]
        at = point.time_from_start
        assert at.sec + at.nanosec * 1e-9 == (index + 1) / 8


def test_replies_of_every_size_arrive(start, client):
    start_server(start)
    service = client.service(SampleTrajectory, SERVICE)
    # About 160 bytes a point: one datagram of 1452 bytes holds 6, a DATA of 8192 holds 49.
    for points in [*range(1, 13), 30, *range(45, 55), 100, 200, 500]:
        response, _ = client.call(service, SampleTrajectory.Request(count=points))
        assert_complete(response, points)


def test_no_first_call_of_20_fresh_clients_stalls(start, make_client):
    start_server(start)
    took = []
    for number in range(20):
        client = make_client(f"fresh_{number}")
        service = client.node.create_client(SampleTrajectory, SERVICE)
        # As soon as the server is seen, as a C++ client does; rclpy's own wait_for_service looks
        # every 0.25 s, by when the server has long seen the client too.
        assert wait_until(service.service_is_ready, 10.0, every=0.0) is not None
        response, seconds = client.call(service, SampleTrajectory.Request(count=1))
        assert_complete(response, 1)
        took.append(round(seconds, 3))
        client.close()
    print("first calls, s:", took)
    assert max(took) < 1.0, took


def test_no_first_call_to_20_fresh_servers_stalls(start, make_client):
    """Client and server start together, so that each discovers the other at the same time."""
    took = []
    for number in range(20):
        server = start_node(start)
        user = User(make_client(f"first_{number}"))
        service = user.client.service(Trigger, "/tcvae/sample")
        response, seconds = user.client.call(service, Trigger.Request())
        assert "NO_TASK" in response.message
        took.append(round(seconds, 3))
        user.client.close()
        assert server.interrupt() == 0
    print("first calls, s:", took)
    assert max(took) < 1.0, took


def test_endpoints_are_gone_within_a_second_of_sigint(start, client):
    server = start_server(start)
    service = client.service(SampleTrajectory, SERVICE)
    client.call(service, SampleTrajectory.Request(count=1))
    assert client.spin_until(lambda: "dds_probe" in client.node.get_node_names(), 5.0) is not None
    assert server.interrupt() == 0

    def gone():
        return not service.service_is_ready() and "dds_probe" not in client.node.get_node_names()

    took = client.spin_until(gone, 1.0)
    assert took is not None, "the server's endpoints are still in the graph after 1 s"


def test_a_reply_of_a_megabyte_arrives_quickly(start, client):
    start_server(start)
    service = client.service(SampleTrajectory, SERVICE)
    took = []
    for _ in range(5):
        response, seconds = client.call(service, SampleTrajectory.Request(count=6300), 30.0)
        assert_complete(response, 6300)
        took.append(round(seconds, 3))
    print("replies of 6300 points (1.3 MB), s:", took)
    assert statistics.median(took) < 1.5, took


# Requests and answers wait in queues of 10 (the default QoS of services): of more at once some may be pushed out.
CALLS_AT_ONCE = 10
CALL_ONCE_AND_WAIT = """
import rclpy
from lifecycle_msgs.srv import GetState
rclpy.init()
node = rclpy.create_node("stands_still")
client = node.create_client(GetState, "/tcvae/get_state")
client.wait_for_service()
rclpy.spin_until_future_complete(node, client.call_async(GetState.Request()))
print("answered", flush=True)
rclpy.spin(node)
"""


def test_a_client_that_stands_still_holds_up_nobody(start, make_client, domain):
    """It acknowledges nothing until it is given up, 20 s later; a writer sends 8192 samples ahead of the slowest."""
    start_node(start)
    client = make_client()
    service = client.service(GetState, "/tcvae/get_state")
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    still = Process(Path(sys.executable), ["-c", CALL_ONCE_AND_WAIT], environment)
    try:
        still.wait_for("answered", 20.0)
        still.signal(signal.SIGSTOP)
        slowest = 0.0
        for answered in range(0, 8400, CALLS_AT_ONCE):
            futures = [service.call_async(GetState.Request()) for _ in range(CALLS_AT_ONCE)]
            took = client.spin_until(lambda: all(future.done() for future in futures), 10.0)
            missing = sum(not future.done() for future in futures)
            assert took is not None, f"{missing} of {CALLS_AT_ONCE} calls after {answered} were not answered"
            slowest = max(slowest, took)
        assert "stands_still" in client.node.get_node_names(), "it was given up: nothing was held up by it"
        print(f"8400 calls beside a client that stands still, the slowest {CALLS_AT_ONCE} in {slowest:.2f} s")
    finally:
        still.kill()

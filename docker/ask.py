"""Asks a running node for a motion, as a user does: `PYTHONPATH=tests/interop python docker/ask.py DOMAIN`, with the
Python of tests/interop/environment.py. docker/test.sh calls it."""

import sys

from conftest import Client
from std_srvs.srv import Trigger
from user import User


def main(domain):
    client = Client(domain, "docker_test")
    try:
        # Not before the node is on the graph.
        client.service(Trigger, "/tcvae/sample", timeout=30.0)
        user = User(client)
        user.publish_location("source_cup", 0.60, 0.10)
        joints, _, path = user.ask(0.65, 0.35)
        assert len(joints.joint_names) == 7 and len(joints.points) == len(path.poses)
        print(f"{len(joints.points)} points for {', '.join(joints.joint_names)}")
        answer = user.call(Trigger, "sample")
        assert answer.success, answer.message
        assert user.trajectory() is not None
        print(f"/tcvae/sample: {answer.message or 'published'}")
    finally:
        client.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))

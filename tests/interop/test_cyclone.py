"""Topics and services as rmw_cyclonedds_cpp names them and lays them out, through Cyclone DDS (PyPI's cyclonedds)."""

import json
import os
import sys
from pathlib import Path

import pytest
from conftest import Process, start_node

HERE = Path(__file__).resolve().parent
LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""


@pytest.fixture
def client(start, domain):
    """What cyclone.py says."""
    start_node(start, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")

    def run(*arguments):
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": LOOPBACK}
        process = Process(Path(sys.executable), [HERE / "cyclone.py", *arguments], environment)
        assert process.wait(60.0) == 0, process.output
        return json.loads(process.lines[-1])

    return run


def test_every_call_of_a_cyclone_client_is_answered(client):
    told = client("calls", "20")
    assert len(told["answers"]) == 20, told
    assert all(not success and "NO_TASK" in message for success, message in told["answers"])


def test_goals_of_a_cyclone_client_become_trajectories_and_a_late_joiner_learns_the_model(client):
    told = client("goals", "20")
    assert told["model"]["robot"] == "baxter", told["model"]
    assert len(told["trajectories"]) == 20
    for joints, points, _ in told["trajectories"]:
        assert joints == told["trajectories"][0][0] and len(joints) == 7
        assert len(points) == 100 and all(len(positions) == 7 for positions in points)
    firsts = {tuple(points[0]) for _, points, _ in told["trajectories"]}
    assert len(firsts) == 10, "ten goals, twice each"

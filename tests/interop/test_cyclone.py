"""Services as rmw_cyclonedds_cpp lays them out, called through Cyclone DDS (PyPI's cyclonedds)."""

import json
import os
import sys
from pathlib import Path

from conftest import Process, start_node

HERE = Path(__file__).resolve().parent
LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""


def test_every_call_of_a_cyclone_client_is_answered(start, domain):
    start_node(start, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": LOOPBACK}
    client = Process(Path(sys.executable), [HERE / "cyclone.py", "20"], environment)
    assert client.wait(60.0) == 0, client.output
    told = json.loads(client.lines[-1])
    assert len(told["answers"]) == 20, told
    assert all(not success and "NO_TASK" in message for success, message in told["answers"])

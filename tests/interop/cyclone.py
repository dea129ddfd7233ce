"""A client of ~/sample as rmw_cyclonedds_cpp lays out services, on Cyclone DDS itself; a process of its own, since no two
DDS libraries should share one.

    python cyclone.py COUNT    calls COUNT times, and prints a line of JSON: {"answers": [...], "seconds": [...]}
"""

import json
import os
import random
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

QOS = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10), Policy.Durability.Volatile)


@dataclass
class Request(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Request_"):
    """The header of rmw_cyclonedds_cpp, and the byte that stands for no fields."""

    client: uint64
    number: int64
    structure_needs_at_least_one_member: uint8


@dataclass
class Response(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


def main():
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    writer = DataWriter(participant, Topic(participant, "rq/tcvae/sampleRequest", Request, qos=QOS), qos=QOS)
    reader = DataReader(participant, Topic(participant, "rr/tcvae/sampleReply", Response, qos=QOS), qos=QOS)
    end = time.monotonic() + 20.0
    while not (writer.get_matched_subscriptions() and reader.get_matched_publications()):
        assert time.monotonic() < end, "the service was not found"
        time.sleep(0.01)
    client, told = random.getrandbits(64), {"answers": [], "seconds": []}
    for number in range(1, int(sys.argv[1]) + 1):
        began = time.monotonic()
        writer.write(Request(client, number, 0))
        while time.monotonic() < began + 5.0:
            mine = [r for r in reader.take(10) if r.client == client and r.number == number]
            if mine:
                told["answers"].append([mine[0].success, mine[0].message])
                told["seconds"].append(time.monotonic() - began)
                break
            time.sleep(0.002)
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()

"""Bytes that are no messages: on every topic and service that the node hears, and at its ports. It goes on as before.

TCVAE_GARBAGE says how many there are of each kind (10,000; the machine and not the node sets how fast they go).
"""

import json
import os
import random
import socket
import struct
from collections import Counter

from conftest import BINARIES, ROOT, Process, start_node
from user import User

SEEDS = ROOT / "fuzz" / "seeds" / "node"
COUNT = int(os.environ.get("TCVAE_GARBAGE", "10000"))
SOURCE = (0.60, 0.10)
GOAL = (0.65, 0.37)
# RTPS 2.5, 8.3.3.2 and 9.4.5: PAD, ACKNACK, HEARTBEAT, GAP, INFO_TS, INFO_SRC, INFO_REPLY_IP4, INFO_DST, INFO_REPLY,
# NACK_FRAG, HEARTBEAT_FRAG, DATA, DATA_FRAG, the security ones, and vendors' own.
SUBMESSAGES = [0x01, 0x06, 0x07, 0x08, 0x09, 0x0C, 0x0D, 0x0E, 0x0F, 0x12, 0x13, 0x15, 0x16, 0x30, 0x31, 0x32, 0x33, 0x80]
# Unknown, and the built-in endpoints for participants, publications and subscriptions, and their liveliness.
ENTITIES = [0x0, 0x000100C2, 0x000100C7, 0x000003C2, 0x000003C7, 0x000004C2, 0x000004C7, 0x000200C2, 0x000200C7]


def memory(process):
    with open(f"/proc/{process.pid}/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def assert_serves(user):
    user.publish_location("source_cup", *SOURCE)
    joints, _, _ = user.ask(*GOAL)
    assert len(joints.points) > 50


def garble(domain, count, seed):
    """Writes that many spoilt messages to everything that the node hears: how many it were, by topic of DDS."""
    # What is sound by chance is done: it may end a node that is managed, so that this is left to the fuzzer.
    path, spared = BINARIES / "examples" / "interop_garbler", ["change_state"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "LD_LIBRARY_PATH": ""}
    garbler = Process(path, ["/tcvae", str(count), str(seed), str(SEEDS), *spared], environment)
    try:
        assert garbler.wait(60.0 + 0.05 * count) == 0, garbler.output
        return json.loads(garbler.lines[-1])
    finally:
        garbler.kill()


def test_garbage_on_every_topic_and_service(start, make_client, domain):
    """Each gets a tenth of the messages."""
    node = start_node(start)
    user = User(make_client())
    assert_serves(user)
    heard = [name for name, _ in user.client.node.get_subscriber_names_and_types_by_node("tcvae", "/")]
    # An action's services are not told as such, and its client is the controller's.
    served = [name for name, _ in user.client.node.get_service_names_and_types_by_node("tcvae", "/")]
    expected = {f"rt{name}" for name in heard if "/_action/" not in name}
    expected |= {f"rq{name}Request" for name in served if not name.endswith("change_state")}
    sent = Counter(garble(domain, COUNT // 20, 1))
    assert expected <= set(sent), expected - set(sent)
    # What is kept of clients that have no end for answers is kept by now.
    before = memory(node)
    sent += Counter(garble(domain, COUNT // 20, 2))
    assert node._popen.poll() is None, node.output[-2000:]
    assert "panicked" not in node.output, node.output[-2000:]
    user.looked_at = len(user.joints)
    assert_serves(user)
    print(f"{sum(sent.values())} messages on {len(sent)} topics; {before >> 20} MB, then {memory(node) >> 20} MB")
    assert memory(node) < 1.1 * before + (8 << 20)


def packet(chance):
    """Something that looks the more like RTPS the longer one looks."""
    kind = chance.randrange(10)
    if kind == 0:
        return chance.randbytes(chance.randrange(1400))
    header = b"RTPS" + bytes([2, chance.choice([1, 2, 3, 4, 5, 9])]) + chance.choice([b"\x01\x0f", b"\x01\x12", b"\xff\xff"])
    header += chance.randbytes(12)
    if kind == 1:
        return header[: chance.randrange(len(header))]
    data = header
    for _ in range(chance.randrange(1, 6)):
        number, flags = chance.choice(SUBMESSAGES), chance.randrange(256)
        order = "<" if flags & 1 else ">"
        words = [chance.choice(ENTITIES), chance.choice(ENTITIES)]
        body = struct.pack(">II", *words) if chance.random() < 0.5 else struct.pack(">II", *reversed(words))
        if number in (0x15, 0x16):
            body = struct.pack(order + "HH", 0, chance.choice([16, 28, 0, 65535])) + body
        numbers = [chance.choice([0, 1, 2, 7, 0x7FFFFFFF, 0xFFFFFFFF, chance.getrandbits(32)])
                   for _ in range(chance.randrange(2, 12))]
        body += struct.pack(f"{order}{len(numbers)}I", *numbers)
        if chance.random() < 0.5:
            # A list of parameters: participant and endpoint discovery.
            body += b"\x00\x03\x00\x00"
            for _ in range(chance.randrange(8)):
                length = chance.choice([0, 4, 8, 12, 16, 24, 65532])
                body += struct.pack("<HH", chance.choice([0x15, 0x16, 0x50, 0x52, 0x5A, 0x05, 0x07, 0x02, 0x31, 0x32, 0x2C,
                                                         0x58, chance.getrandbits(16)]), length)
                body += chance.randbytes(min(length, 64))
            body += b"\x01\x00\x00\x00"
        length = chance.choice([len(body), len(body), len(body), 0, 65535, chance.randrange(65536)])
        data += struct.pack(order.replace(">", ">") + "BBH", number, flags, length) + body
    return data[:60000]


def test_garbage_at_the_ports(start, make_client, domain):
    node = start_node(start)
    user = User(make_client())
    assert_serves(user)
    base = 7400 + 250 * domain
    # Those of multicast, and those of the first participants; the node has one of these.
    ports = [base, base + 1] + [base + 10 + offset for offset in range(8)]
    chance, sender = random.Random(7), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    mine = {p for p in ports if owned(node.pid, p)}
    assert len(mine) >= 2, "the node's ports were not found"
    for half in range(2):
        for i in range(COUNT * 5 // 2):
            sender.sendto(packet(chance), ("127.0.0.1", chance.choice(sorted(mine))))
            if i % 200 == 0:
                user.wait(0.01)
        user.wait(1.0)
        if half == 0:
            # What is kept of others for a while is kept by now.
            before = memory(node)
    assert node._popen.poll() is None, node.output[-2000:]
    assert "panicked" not in node.output, node.output[-2000:]
    user.looked_at = len(user.joints)
    assert_serves(user)
    assert memory(node) < 1.05 * before + (2 << 20)


def owned(pid, port):
    """Whether a process has this UDP port."""
    inodes = set()
    for name in os.listdir(f"/proc/{pid}/fd"):
        try:
            target = os.readlink(f"/proc/{pid}/fd/{name}")
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    with open("/proc/net/udp") as table:
        for line in list(table)[1:]:
            words = line.split()
            if int(words[1].split(":")[1], 16) == port and words[9] in inodes:
                return True
    return False

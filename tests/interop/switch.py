"""A switch between two ports, which treats packets badly if told to.

    python switch.py PORT PORT [--lose SHARE] [--delay SHARE] [--no-multicast] [--seed S]
    python switch.py checksums INTERFACE    makes the kernel compute them all

A delayed packet comes 20 ms later, so that others overtake it.
"""

import argparse
import ctypes
import fcntl
import heapq
import random
import select
import socket
import struct
import sys
import time

EVERY_PROTOCOL = 0x0003
SIOCETHTOOL = 0x8946
SET_TX_CHECKSUMS = 0x00000017


def compute_checksums(interface):
    """ethtool -K INTERFACE tx off"""
    value = (ctypes.c_uint32 * 2)(SET_TX_CHECKSUMS, 0)
    request = struct.pack("16sP", interface.encode(), ctypes.addressof(value))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SIOCETHTOOL, request)


def main():
    if sys.argv[1] == "checksums":
        compute_checksums(sys.argv[2])
        return
    parser = argparse.ArgumentParser()
    parser.add_argument("ports", nargs=2)
    parser.add_argument("--lose", type=float, default=0.0)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--no-multicast", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    chance, ports, late, count = random.Random(arguments.seed), [], [], 0
    for name in arguments.ports:
        port = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERY_PROTOCOL))
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)
        port.bind((name, EVERY_PROTOCOL))
        ports.append(port)
    print("ready", flush=True)
    while True:
        wait = max(0.0, late[0][0] - time.monotonic()) if late else 1.0
        readable, _, _ = select.select(ports, [], [], wait)
        while late and late[0][0] <= time.monotonic():
            _, _, out, frame = heapq.heappop(late)
            out.send(frame)
        for port in readable:
            frame, address = port.recvfrom(65535)
            if address[2] == socket.PACKET_OUTGOING:
                continue
            # Bytes 12 and 13 say IPv4; a group's hardware address begins with an odd byte.
            is_ipv4 = frame[12:14] == b"\x08\x00"
            if is_ipv4 and arguments.no_multicast and frame[0] & 1:
                continue
            if is_ipv4 and chance.random() < arguments.lose:
                continue
            out = ports[1 - ports.index(port)]
            if is_ipv4 and chance.random() < arguments.delay:
                count += 1
                heapq.heappush(late, (time.monotonic() + 0.02, count, out, frame))
            else:
                out.send(frame)


if __name__ == "__main__":
    main()

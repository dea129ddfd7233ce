"""Fixtures for tests with real rclpy: a domain of one's own, binaries to start, and rclpy nodes.

The binaries are taken from $TCVAE_BIN_DIR (cargo's target/debug by default), examples from
its examples/. `./x test` builds them and sets it. Everything stays on loopback.
"""

import fcntl
import os
import random
import signal
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import pytest

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"

import rclpy  # noqa: E402  (after its environment is set)
from rclpy.action import ActionClient  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
BINARIES = Path(os.environ.get("TCVAE_BIN_DIR", ROOT / "target" / "debug"))


def wait_until(condition, timeout, every=0.01):
    """The seconds until `condition()` holds; None if it does not within `timeout` seconds."""
    start = time.monotonic()
    while True:
        if condition():
            return time.monotonic() - start
        if time.monotonic() - start > timeout:
            return None
        time.sleep(every)


@pytest.fixture
def domain():
    """A ROS domain that no other test on this machine uses, held for the length of the test."""
    # Above 101 the ports may meet those that Linux gives to outgoing connections.
    for number in random.sample(range(1, 102), 101):
        lock = open(Path(tempfile.gettempdir()) / f"tcvae-test-domain-{number}.lock", "w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        with lock:
            yield number
        return
    pytest.fail("all 101 test domains are in use")


class Process:
    """A started binary: what it printed, and ways to end it."""

    def __init__(self, path, arguments, environment):
        assert path.is_file(), f"{path} is not built; ./x test builds it, or set TCVAE_BIN_DIR"
        self.lines = []
        self._popen = subprocess.Popen(
            [path, *arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.pid = self._popen.pid
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._popen.stdout:
            self.lines.append(line.rstrip("\n"))

    @property
    def output(self):
        return "\n".join(self.lines)

    def wait_for(self, text, timeout=10.0):
        """Waits until a line with `text` was printed; the seconds that took."""
        def printed():
            if self._popen.poll() is not None:
                self._reader.join(1.0)
                assert text in self.output, f"ended ({self._popen.returncode}):\n{self.output}"
            return text in self.output

        took = wait_until(printed, timeout)
        assert took is not None, f"no {text!r} within {timeout} s:\n{self.output}"
        return took

    def signal(self, number):
        self._popen.send_signal(number)

    def interrupt(self, timeout=5.0):
        """Ctrl-C; the exit status."""
        self.signal(signal.SIGINT)
        return self.wait(timeout)

    def wait(self, timeout=5.0):
        """Waits for the end; the exit status."""
        status = self._popen.wait(timeout)
        self._reader.join(1.0)
        return status

    def kill(self):
        if self._popen.poll() is None:
            self._popen.kill()
            self._popen.wait()


@pytest.fixture
def start(domain, request):
    """Starts a binary in the test's domain: start("tcvae_node", "--ros-args", ..., NAME="value")."""
    started = []

    def start(name, *arguments, **environment):
        merged = os.environ | {"ROS_DOMAIN_ID": str(domain)} | environment
        # rclpy's wheels set this for themselves; our binaries are no part of them.
        merged.pop("LD_LIBRARY_PATH", None)
        process = Process(BINARIES / name, arguments, merged)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        print(f"--- output of process {process.pid}\n{process.output}")  # shown where a test fails


class Client:
    """An rclpy node with a context and a participant of its own."""

    def __init__(self, domain, name):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def spin_until(self, condition, timeout):
        """Handles callbacks until `condition()` holds; the seconds that took, or None."""
        start = time.monotonic()
        while not condition():
            left = start + timeout - time.monotonic()
            if left <= 0:
                return None
            self.executor.spin_once(timeout_sec=min(left, 0.05))
        return time.monotonic() - start

    def service(self, kind, name, timeout=10.0):
        """A service client whose server was found."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout), f"no service {name} within {timeout} s"
        return client

    def call(self, client, request, timeout=10.0):
        """Calls a service: (response, seconds). Fails when no answer comes in time."""
        future = client.call_async(request)
        took = self.spin_until(future.done, timeout)
        assert took is not None, f"{client.srv_name} did not answer within {timeout} s"
        return future.result(), took

    def close(self):
        if self.context.ok():
            self.executor.shutdown()
            # destroy_node leaves them, and with them the participant: the next test in this domain would meet it.
            for waitable in list(self.node.waitables):
                if isinstance(waitable, ActionClient):
                    waitable.destroy()
            self.node.destroy_node()
            rclpy.shutdown(context=self.context)


@pytest.fixture
def make_client(domain):
    """Makes rclpy clients in the test's domain: make_client("name")."""
    made = []

    def make_client(name="test_client"):
        made.append(Client(domain, name))
        return made[-1]

    yield make_client
    for client in made:
        client.close()


@pytest.fixture
def client(make_client):
    """One rclpy client."""
    return make_client()


def start_node(start, *arguments, **environment):
    """Starts tcvae_node and waits until it is ready."""
    process = start("tcvae_node", *arguments, **environment)
    process.wait_for("Try, in another shell")
    return process


@pytest.fixture
def node(start):
    """The node as it is without arguments."""
    return start_node(start)


@pytest.fixture
def user(node, make_client):
    """An rclpy client that the node's topics are matched with."""
    from user import User

    return User(make_client("user"))

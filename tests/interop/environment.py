"""Makes .venv-kilted or .venv-jazzy: real rclpy from PyPI, with msg/tcvae_msgs built into it; or .venv-verify,
for the program in tests/verify.

    python3 tests/interop/environment.py [kilted|jazzy|verify]

`./x test` runs this; it does nothing when the environment is up to date. It needs Python 3.12,
for which the wheels are made ($PYTHON, python3.12, a pyenv version, or python3 if it is one), and
a C++ compiler. On standard output it prints the path of the environment's Python, which needs no
environment variables.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PACKAGES = [ROOT / "msg" / "tcvae_msgs", HERE / "ros" / "tf2_msgs", HERE / "ros" / "control_msgs"]


def is_python312(candidate):
    probe = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([candidate, "-c", probe], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and done.stdout.strip() == "3.12"


def python312():
    """A Python 3.12 that can make virtual environments."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [
        os.environ.get("PYTHON"),
        shutil.which("python3.12"),
        *sorted(map(str, pyenv.glob("3.12*/bin/python3.12")), reverse=True),
        shutil.which("python3"),
    ]
    for candidate in candidates:
        if candidate and is_python312(candidate):
            return candidate
    sys.exit(
        "environment: no Python 3.12 with venv found, and the rclpy wheels need exactly that.\n"
        "Install it (Ubuntu 24.04: apt install python3.12-venv; elsewhere: pyenv install 3.12,\n"
        "or uv python install 3.12) or name one: PYTHON=/path/to/python3.12 ./x test"
    )


def compiler():
    """Stops where no C++ compiler is installed, before anything is downloaded."""
    if not any(map(shutil.which, [os.environ.get("CXX", "c++"), "g++", "clang++"])):
        sys.exit("environment: no C++ compiler found, and the message package needs one.\n"
                 "Install it (Debian, Ubuntu: apt install g++)")


def digest(*paths):
    """One SHA-256 over the given files, and over all files below the given folders."""
    total = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                total.update(f"{file.relative_to(ROOT).as_posix()}\0".encode())
                total.update(file.read_bytes())
    return total.hexdigest()


def run(command, **options):
    """Runs a command quietly, and shows what it printed when it fails."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)
    if done.returncode != 0:
        sys.stderr.buffer.write(done.stdout)
        sys.exit(f"environment: `{' '.join(map(str, command))}` failed (exit {done.returncode})")
    return done.stdout.decode()


def install(python, venv, requirements):
    """A fresh virtual environment with exactly the pinned wheels."""
    shutil.rmtree(venv, ignore_errors=True)
    run([python, "-m", "venv", venv])
    pip = [venv / "bin" / "python", "-m", "pip", "install", "--quiet", "--no-deps"]
    run([*pip, "-r", requirements])
    # The wheels' exported CMake files name the Python of the machine that built them.
    paths = "import sysconfig; p = sysconfig.get_paths(); print(p['include']); print(p['purelib'])"
    include, site = run([venv / "bin" / "python", "-c", paths]).split()
    for file in venv.rglob("*.cmake"):
        text = file.read_text(errors="surrogateescape")
        if "/opt/python/" in text:
            text = re.sub(r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+", include, text)
            text = re.sub(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages", site, text)
            file.write_text(text, errors="surrogateescape")


def build(venv, package):
    """Builds a rosidl interface package into the environment."""
    # A clean environment: a sourced ROS installation must not leak into the build.
    environment = {
        "HOME": str(Path.home()),
        "PATH": f"{venv}/bin:/usr/local/bin:/usr/bin:/bin",
        "AMENT_PREFIX_PATH": str(venv),
        "LD_LIBRARY_PATH": str(venv / "lib"),
    }
    environment |= {name: os.environ[name] for name in ("CC", "CXX") if name in os.environ}
    with tempfile.TemporaryDirectory() as scratch:
        cmake = ["cmake", "-G", "Ninja", "-S", str(package), "-B", scratch]
        cmake += [f"-DCMAKE_INSTALL_PREFIX={venv}", f"-DCMAKE_PREFIX_PATH={venv}"]
        cmake += [f"-DPython3_EXECUTABLE={venv}/bin/python", "-DPython3_FIND_VIRTUALENV=ONLY"]
        cmake += ["-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release"]
        cmake[0] = f"{venv}/bin/cmake"
        run(cmake, env=environment)
        run([f"{venv}/bin/ninja", "-C", scratch, "install"], env=environment)


def make(distro):
    """Brings the environment up to date, doing no more than needed; the path of its Python."""
    venv = ROOT / f".venv-{distro}"
    requirements = HERE / f"requirements-{distro}.txt"
    steps = [("wheels", [requirements, HERE / "environment.py"])]
    steps += [(package.name, [package]) for package in PACKAGES]
    for name, sources in steps:
        stamp, wanted = venv / f"made-{name}", digest(*sources)
        if stamp.is_file() and stamp.read_text() == wanted:
            continue
        if name == "wheels":
            python = python312()
            compiler()
            print(f"environment: rclpy of {distro} into {venv.name}, about a minute", file=sys.stderr)
            install(python, venv, requirements)
        else:
            print(f"environment: building {name} for {distro}, about a minute", file=sys.stderr)
            build(venv, sources[0])
        stamp.write_text(wanted)
    return venv / "bin" / "python"


def make_verify():
    """Likewise the environment of tests/verify, which is wheels alone."""
    venv, requirements = ROOT / ".venv-verify", ROOT / "tests" / "verify" / "requirements.txt"
    stamp, wanted = venv / "made-wheels", digest(requirements)
    if not (stamp.is_file() and stamp.read_text() == wanted):
        print(f"environment: the wheels of tests/verify into {venv.name}", file=sys.stderr)
        shutil.rmtree(venv, ignore_errors=True)
        run([python312(), "-m", "venv", venv])
        run([venv / "bin" / "python", "-m", "pip", "install", "--quiet", "-r", requirements])
        stamp.write_text(wanted)
    return venv / "bin" / "python"


if __name__ == "__main__":
    chosen = sys.argv[1] if len(sys.argv) > 1 else "kilted"
    if chosen == "verify":
        print(make_verify())
        sys.exit()
    if not (HERE / f"requirements-{chosen}.txt").is_file():
        sys.exit(f"environment: no requirements-{chosen}.txt; known are kilted, jazzy and verify")
    print(make(chosen))

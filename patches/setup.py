"""Makes third_party/NAME for each folder patches/NAME: the registry's own source of that crate, with the
folder's patches applied.

`./x setup` runs this. The sources come from cargo, through the locked manifest in
patches/registry, and their SHA-256 is compared with the one in that lock file. The patches apply
exactly (same lines at the same numbers) or not at all. The result replaces third_party/NAME
in one rename, so an interrupted run leaves nothing half done; a tree that was edited or damaged
afterwards is found by its digest and made again.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = sorted(path.parent.name for path in HERE.glob("*/0001-*.patch"))
THIRD_PARTY = HERE.parent / "third_party"
STAMP = ".made-by-x-setup"


class SetupError(Exception):
    """A message for the person at the terminal."""


def locked(name):
    """Version and SHA-256 of a package in the registry manifest's lock file."""
    lock = (HERE / "registry" / "Cargo.lock").read_text()
    for package in lock.split("[[package]]"):
        if f'\nname = "{name}"\n' in package:
            version = re.search(r'^version = "(.+)"$', package, re.M)
            checksum = re.search(r'^checksum = "([0-9a-f]{64})"$', package, re.M)
            if version and checksum:
                return version[1], checksum[1]
    raise SetupError(f"patches/registry/Cargo.lock names no {name} with a checksum")


def run(command):
    """The standard output of a command of the Rust toolchain."""
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True, cwd=HERE.parent)
    except FileNotFoundError:
        message = f"`{command[0]}` not found: install Rust from https://rustup.rs"
        raise SetupError(message) from None
    except subprocess.CalledProcessError as error:
        message = f"`{' '.join(command)}` failed (exit {error.returncode}), see above"
        raise SetupError(message) from None
    return done.stdout.decode()


def registry_crate(name, version):
    """Lets cargo download the crate (or find it in its cache); the path of the .crate file."""
    cargo = os.environ.get("CARGO", "cargo")
    rustc = os.environ.get("RUSTC", "rustc")
    version_lines = run([rustc, "-vV"]).splitlines()
    host = next(line[len("host: ") :] for line in version_lines if line.startswith("host: "))
    manifest = str(HERE / "registry" / "Cargo.toml")
    command = [cargo, "metadata", "--locked", "--format-version", "1", "--manifest-path", manifest]
    answer = run([*command, "--filter-platform", host])
    packages = json.loads(answer)["packages"]
    source = next(Path(p["manifest_path"]).parent for p in packages if p["name"] == name)
    # <cargo home>/registry/src/<registry>/<crate> beside <cargo home>/registry/cache/<registry>/
    crate = source.parents[2] / "cache" / source.parent.name / f"{name}-{version}.crate"
    if not crate.is_file():
        raise SetupError(
            f"cargo has {name} {version} at {source}, but not its archive {crate}: "
            "set-up needs the archive, to verify it. Remove that folder and run ./x setup again"
        )
    return crate


def unpack(archive, top, into):
    """Unpacks the regular files of a .crate archive below `into`, without its top folder."""
    with tarfile.open(archive, "r:gz") as tar:
        for member in tar:
            first, _, rest = member.name.partition("/")
            if member.isdir():
                continue
            if not member.isfile() or first != top or not rest or ".." in rest.split("/"):
                raise SetupError(f"{archive}: unexpected entry {member.name!r}")
            path = into / rest
            path.parent.mkdir(parents=True, exist_ok=True)
            with tar.extractfile(member) as source, open(path, "wb") as out:
                shutil.copyfileobj(source, out)


HUNK = re.compile(r"@@ -(\d+)(?:,(\d+))? \+\d+(?:,(\d+))? @@")


def apply(patch, root):
    """Applies one unified diff strictly: each hunk at its line number, every context line equal."""
    lines = patch.read_text().splitlines(keepends=True)
    position = 0
    changed = 0
    while position < len(lines):
        if not lines[position].startswith("--- a/"):
            position += 1  # the header that says what the patch is for
            continue
        name = lines[position][len("--- a/"):].split("\t")[0].strip()
        if lines[position + 1].split("\t")[0].strip() != f"+++ b/{name}":
            raise SetupError(f"{patch.name}: '--- a/{name}' is not followed by '+++ b/{name}'")
        position += 2
        path = root / name
        old = path.read_text().splitlines(keepends=True) if path.exists() else []  # a new file: @@ -0,0
        new, taken = [], 0
        while position < len(lines) and (hunk := HUNK.match(lines[position])):
            start = max(int(hunk[1]) - 1, 0)
            left, right = int(hunk[2] or 1), int(hunk[3] or 1)
            new += old[taken:start]
            taken = start
            position += 1
            while left > 0 or right > 0:
                line = lines[position] if position < len(lines) else ""
                position += 1
                kind, text = line[:1], line[1:]
                if kind not in (" ", "-", "+"):
                    raise SetupError(f"{patch.name}: hunk for {name} ends early, at {line!r}")
                if kind != "+":
                    found = old[taken] if taken < len(old) else "(end of file)"
                    if found != text:
                        raise SetupError(
                            f"{patch.name} does not fit {name}, line {taken + 1}:\n"
                            f"  expected {text!r}\n  found    {found!r}\n"
                            "Was the pinned version changed? The patch must be made anew for it"
                        )
                    taken += 1
                    left -= 1
                if kind != "-":
                    new.append(text)
                    right -= 1
        path.write_text("".join(new + old[taken:]))
        changed += 1
    if not changed:
        raise SetupError(f"{patch.name}: holds no diff")


def digest(root):
    """One SHA-256 over the names and contents of all files below `root` but the stamp."""
    total = hashlib.sha256()
    for path in sorted(p for p in root.rglob("*") if p.is_file() and p.name != STAMP):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(root).as_posix()} {content}\n".encode())
    return total.hexdigest()


def inputs(name, checksum, patches):
    """What the tree is made from, one line each."""
    # Without the patches' headers, whose wording changes nothing that is built.
    diffs = [p.read_text().partition("\n--- a/")[2] for p in patches]
    named = [f"{hashlib.sha256(d.encode()).hexdigest()} {p.name}" for d, p in zip(diffs, patches)]
    return "\n".join([f"{checksum} {name}", *named]) + "\n"


def state(target, expected):
    """None when the tree is as `expected`, else why it has to be made."""
    if not target.exists():
        return "it does not exist yet"
    stamp = target / STAMP
    if not stamp.is_file():
        return "it was not finished"
    made_from, _, tree = stamp.read_text().rpartition("tree ")
    if made_from != expected:
        return "the patches or the pinned version changed"
    if tree.strip() != digest(target):
        return "its files were changed"
    return None


def make(name):
    """Makes the tree of one crate, unless it is up to date."""
    target = THIRD_PARTY / name
    version, checksum = locked(name)
    patches = sorted((HERE / name).glob("*.patch"))
    expected = inputs(name, checksum, patches)
    where = f"third_party/{name}"
    reason = state(target, expected)
    if reason is None:
        print(f"setup: {where} is up to date ({name} {version}, {len(patches)} patches)")
        return
    print(f"setup: making {where}: {reason}", flush=True)
    crate = registry_crate(name, version)
    found = hashlib.sha256(crate.read_bytes()).hexdigest()
    if found != checksum:
        raise SetupError(
            f"{crate} has SHA-256 {found}, but patches/registry/Cargo.lock says {checksum}. "
            "Delete that file and run ./x setup again"
        )
    print(f"setup: {name} {version} from the registry, SHA-256 {checksum[:16]}... verified")
    THIRD_PARTY.mkdir(exist_ok=True)
    # Fresh modification times throughout, so that cargo notices every change.
    with tempfile.TemporaryDirectory(prefix=f".{name}-", dir=THIRD_PARTY) as scratch:
        tree = Path(scratch) / name
        unpack(crate, f"{name}-{version}", tree)
        for patch in patches:
            apply(patch, tree)
            print(f"setup: applied patches/{name}/{patch.name}")
        (tree / STAMP).write_text(f"{expected}tree {digest(tree)}\n")
        if target.exists():
            target.rename(Path(scratch) / "old")
        tree.rename(target)
    print(f"setup: {where} is ready")


def main():
    for name in NAMES:
        make(name)


if __name__ == "__main__":
    try:
        main()
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except OSError as error:
        sys.exit(f"setup: {error}")

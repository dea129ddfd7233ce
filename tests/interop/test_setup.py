"""./x setup: what it makes, what it repairs, what it refuses."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATCH = """A header that says why.

--- a/src/one.rs
+++ b/src/one.rs
@@ -2,3 +2,4 @@
 two
-three
+THREE
+three and a half
 four
"""


@pytest.fixture
def setup(tmp_path):
    """patches/setup.py as a module that makes its tree in a folder of the test's own."""
    spec = importlib.util.spec_from_file_location("x_setup", ROOT / "patches" / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.THIRD_PARTY = tmp_path / "third_party"
    return module


def apply(setup, folder, old):
    patch, file = folder / "a.patch", folder / "src" / "one.rs"
    patch.write_text(PATCH)
    file.parent.mkdir(exist_ok=True)
    file.write_text(old)
    setup.apply(patch, folder)
    return file.read_text()


def test_a_patch_changes_its_lines_and_no_others(setup, tmp_path):
    new = apply(setup, tmp_path, "one\ntwo\nthree\nfour\nfive\n")
    assert new == "one\ntwo\nTHREE\nthree and a half\nfour\nfive\n"


@pytest.mark.parametrize(
    "old",
    [
        "one\ntwo\n3\nfour\nfive\n",  # another line
        "zero\none\ntwo\nthree\nfour\nfive\n",  # at another place
        "one\ntwo\nTHREE\nthree and a half\nfour\nfive\n",  # applied already
        "one\ntwo\nthree\n",  # cut short
    ],
)
def test_a_patch_that_does_not_fit_exactly_is_refused(setup, tmp_path, old):
    with pytest.raises(setup.SetupError, match=r"a\.patch does not fit src/one\.rs, line \d"):
        apply(setup, tmp_path, old)


def test_a_damaged_tree_is_made_again_and_a_whole_one_left_alone(setup, capsys):
    setup.main()
    assert "it does not exist yet" in capsys.readouterr().out
    source = setup.THIRD_PARTY / "rustdds" / "src" / "rtps" / "constant.rs"
    made = source.read_bytes()
    assert b"FRAGMENT_SIZE: usize = 1344" in made
    written = source.stat().st_mtime_ns

    setup.main()
    assert capsys.readouterr().out.count("is up to date") == 2
    assert source.stat().st_mtime_ns == written

    source.write_bytes(made + b"// edited\n")
    setup.main()
    assert "its files were changed" in capsys.readouterr().out
    assert source.read_bytes() == made

    (setup.THIRD_PARTY / "rustdds" / setup.STAMP).unlink()
    setup.main()
    assert "it was not finished" in capsys.readouterr().out
    assert sorted(path.name for path in setup.THIRD_PARTY.iterdir()) == ["ros2-client", "rustdds"]


def test_another_crate_than_the_locked_one_is_refused(setup, tmp_path):
    forged = tmp_path / "rustdds-0.15.1.crate"
    forged.write_bytes(b"not the crate")
    setup.registry_crate = lambda name, version: forged
    with pytest.raises(setup.SetupError, match="has SHA-256 .* but .*Cargo.lock says"):
        setup.main()
    assert not (setup.THIRD_PARTY / "rustdds").exists()

"""docs/interfaces.md is what the node says of itself."""

import os

import reference


def test_the_interface_reference_is_that_of_the_running_node(node, user):
    user.wait(1.0)
    made = reference.markdown(user)
    if os.environ.get("TCVAE_WRITE_REFERENCE"):
        reference.FILE.write_text(made)
    hint = "write it again: TCVAE_WRITE_REFERENCE=1 ./x test ros -k reference"
    assert reference.FILE.is_file() and reference.FILE.read_text() == made, hint


def test_the_fuzzer_knows_everything_that_the_node_hears():
    target = (reference.ROOT / "fuzz" / "fuzz_targets" / "node.rs").read_text()
    parts = [f"{action}/_action/{part}" for action in reference.ACTIONS for part in ("send_goal", "cancel_goal", "get_result")]
    for name in [*reference.HEARD, *reference.SERVICES, *parts, "/clock"]:
        assert f'"{name}"' in target, name

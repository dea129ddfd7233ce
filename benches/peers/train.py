"""One training step of ours beside PyTorch's, on the same cores, in turns.

Both take the same steps first (recognition network, decoder, adversary, two Adams, from the same
weights, on the same batch with the same noise), and the script stops if their likelihoods part. The
PyTorch program is that of tests/golden/tcvae.py, the networks as the paper describes them, with
fused Adams and the likelihood in closed form.

    python3 -m venv .venv-peers
    .venv-peers/bin/pip install numpy safetensors torch==2.15.0
    .venv-peers/bin/python benches/peers/train.py
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch.nn import functional as F

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "golden"))
import tcvae  # noqa: E402

LATENTS, STEPS, STATE, TASK, ADVERSARY = 4, 32, 2, 2, 64
ALPHA, BETA, LEARNING_RATE, COMPARED = 50.0, 4.0, 1e-3, 10


class Peer:
    def __init__(self, width, batch):
        tcvae.LATENTS, tcvae.WIDTH, tcvae.STEPS, tcvae.STATE = LATENTS, width, STEPS, STATE
        tcvae.TASK, tcvae.ADVERSARY, tcvae.BATCH = TASK, ADVERSARY, batch
        torch.manual_seed(1)
        self.recognition = tcvae.Recognition(F.gelu, True)
        self.decoder = tcvae.Decoder(F.gelu, True)
        self.adversary = tcvae.Adversary(F.gelu)
        self.x, self.w = torch.randn(batch, STEPS, STATE), torch.randn(batch, TASK)
        self.noise = torch.randn(batch, LATENTS)
        model = [*self.recognition.parameters(), *self.decoder.parameters()]
        self.adams = [
            torch.optim.Adam(p, lr=LEARNING_RATE, fused=True)
            for p in (model, list(self.adversary.parameters()))
        ]

    def tensors(self):
        players = {"recognition": self.recognition, "decoder": self.decoder, "adversary": self.adversary}
        out = {}
        for prefix, module in players.items():
            for name, t in tcvae.named(prefix, module, lambda p: p).items():
                out[name] = torch.tensor(t["values"]).reshape(t["shape"])
        out |= {"x": self.x.transpose(0, 1).contiguous(), "w": self.w, "noise": self.noise}
        return out

    def step(self):
        batch = len(self.x)
        for adam in self.adams:
            adam.zero_grad()
        mean, log_variance = self.recognition(self.x)
        h = mean + self.noise * torch.exp(log_variance / 2)
        x_mean, x_log_variance = self.decoder(h, self.w)
        squared = (self.x - x_mean).square() * torch.exp(-x_log_variance)
        nll = 0.5 * (squared + x_log_variance + math.log(math.tau)).sum()
        kl = 0.5 * (mean.square() + log_variance.exp() - log_variance - 1).sum()
        l1 = F.l1_loss(self.adversary(mean), self.w, reduction="sum")
        ((nll + BETA * kl - ALPHA * l1) / batch / (STEPS * STATE)).backward()
        self.adams[1].zero_grad()
        (F.l1_loss(self.adversary(mean.detach()), self.w, reduction="sum") / batch).backward()
        for adam in self.adams:
            adam.step()
        return nll.item() / batch

    def times(self, seconds):
        out, end = [], time.perf_counter() + seconds
        while time.perf_counter() < end:
            start = time.perf_counter()
            self.step()
            out.append((time.perf_counter() - start) * 1e6)
        return out


def compare(binary, threads, width, batch, rounds, seconds):
    torch.set_num_threads(threads)
    peer = Peer(width, batch)
    ours, theirs = [], []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        save_file(peer.tensors(), folder / "tensors.safetensors")
        network = {"latents": LATENTS, "width": width}
        asked = {
            "model": {"steps": STEPS, "state_dim": STATE, "task_dim": TASK, "network": network},
            "adversary_width": ADVERSARY, "alpha": ALPHA, "beta": BETA,
            "learning_rate": LEARNING_RATE, "compared": COMPARED, "seconds": seconds,
        }
        (folder / "asked.json").write_text(json.dumps(asked))
        # Freed memory stays with the process, as `tcvae train` asks of glibc.
        kept = {"MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_TRIM_THRESHOLD_": str(1 << 30),
                "MALLOC_TOP_PAD_": str(64 << 20)}
        environment = {**os.environ, **kept, "RAYON_NUM_THREADS": str(threads),
                       "TCVAE_TRAIN_PEER": str(folder)}
        expected = [peer.step() for _ in range(COMPARED)]
        peer.times(seconds)
        for _ in range(rounds):
            theirs.append(statistics.median(peer.times(seconds)))
            text = subprocess.run([binary], env=environment, check=True, capture_output=True, text=True)
            found, times = text.stdout.split("times")
            ours.append(statistics.median(map(float, times.split())))
    difference = max(abs(float(a) - b) for a, b in zip(found.split(), expected, strict=True))
    a, b = statistics.median(ours), statistics.median(theirs)
    print(
        f"| {threads} | {width} | {batch} | {a / 1e3:.2f} | {b / 1e3:.2f} | {a / b:.2f} "
        f"| {difference:.0e} |", flush=True,
    )
    assert difference < 1e-2, f"the two learn differently: {found.split()} {expected}"


def build():
    """The benchmark's binary, as cargo names it."""
    command = ["cargo", "bench", "--locked", "--bench", "train", "--no-run"]
    lines = subprocess.run(
        [*command, "--message-format=json"], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout.splitlines()
    messages = (json.loads(line) for line in lines if line.startswith("{"))
    return [m["executable"] for m in messages if m.get("executable") and m["target"]["name"] == "train"][-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0)
    arguments = parser.parse_args()
    binary = build()
    print(f"PyTorch {torch.__version__}; median of {arguments.rounds} rounds' medians, milliseconds a step")
    print("| threads | width | batch | ours | PyTorch | ratio | largest difference of likelihoods |")
    print("|---|---|---|---|---|---|---|")
    for threads in (1, 2):
        for width in (32, 64):
            for batch in (16, 128):
                compare(binary, threads, width, batch, arguments.rounds, arguments.seconds)

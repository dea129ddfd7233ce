"""Golden numbers for the TC-VAE's networks, objective, gradients and one step of Adam.

An independent program: PyTorch modules as the paper describes them, with ordinary convolutions over
the concatenation of all channels, PyTorch's own autograd and PyTorch's own Adam. The parameters are
then cut into the tensors that the Rust program names (src/model/layout.rs).

    pip install torch==2.15.0 numpy
    python tests/golden/tcvae.py        # writes tests/golden/tcvae.json
"""

import json
import math
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

LATENTS, WIDTH, LAYERS, STEPS, STATE, TASK, ADVERSARY, BATCH = 3, 6, 3, 9, 2, 4, 5, 4
ALPHA, BETA, LEARNING_RATE = 2.5, 1.75, 0.01


class Mlp(nn.Module):
    def __init__(self, inputs, hidden, outputs, act):
        super().__init__()
        self.hidden, self.output, self.act = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs), act

    def forward(self, x):
        return self.output(self.act(self.hidden(x)))


def conv(inputs, dilation):
    return nn.Conv1d(inputs, WIDTH, 3, dilation=dilation, padding=dilation)


class Recognition(nn.Module):
    def __init__(self, act, residual):
        super().__init__()
        self.layers = nn.ModuleList(conv(STATE if i == 0 else WIDTH, 2**i) for i in range(LAYERS))
        self.mean, self.log_variance = Mlp(WIDTH, WIDTH, LATENTS, act), Mlp(WIDTH, WIDTH, LATENTS, act)
        self.act, self.residual = act, residual

    def forward(self, x):  # [batch, steps, state]
        x = x.transpose(1, 2)
        for i, layer in enumerate(self.layers):
            y = self.act(layer(x))
            x = x + y if self.residual and i > 0 else y
        pooled = x.mean(2)
        return self.mean(pooled), self.log_variance(pooled).clamp(-10, 4)


class Decoder(nn.Module):
    """The channels of layer 0 are (phase, code of h, code of w, h), of the others (x, h)."""

    def __init__(self, act, residual):
        super().__init__()
        self.manner, self.task = Mlp(LATENTS, WIDTH, WIDTH, act), Mlp(TASK, WIDTH, WIDTH, act)
        first = 1 + 2 * WIDTH + LATENTS
        self.layers = nn.ModuleList(
            conv(first if i == 0 else WIDTH + LATENTS, 2**i) for i in range(LAYERS)
        )
        self.mean, self.log_variance = Mlp(WIDTH, WIDTH, STATE, act), Mlp(WIDTH, WIDTH, STATE, act)
        self.act, self.residual = act, residual

    def forward(self, h, w):
        phase = torch.arange(1, STEPS + 1, dtype=torch.float32) / STEPS
        along = lambda v: v[:, :, None].expand(-1, -1, STEPS)
        manner, task = along(self.manner(h)), along(self.task(w))
        x = phase[None, None].expand(len(h), 1, STEPS)
        for i, layer in enumerate(self.layers):
            constants = [manner, task, along(h)] if i == 0 else [along(h)]
            y = self.act(layer(torch.cat([x, *constants], 1)))
            x = x + y if self.residual and i > 0 else y
        x = x.transpose(1, 2)
        return self.mean(x), -4 + 8 * torch.tanh(self.log_variance(x) / 8)


class Adversary(nn.Module):
    def __init__(self, act):
        super().__init__()
        sizes = [LATENTS, ADVERSARY, ADVERSARY, TASK]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.act = act

    def forward(self, h):
        h = self.act(self.layers[0](h))
        h = self.act(self.layers[1](h))
        return self.layers[2](h)


def numbers(tensor):
    """The values with the nine digits that tell every float32 from its neighbours."""
    return [float(f"{v:.9g}") for v in tensor.flatten().tolist()]


def named(prefix, module, of):
    """`of` each parameter of a module, as the Rust program names, shapes and splits it."""
    out = {}
    for name, parameter in module.named_parameters():
        value = of(parameter).detach()
        name = f"{prefix}.{name}"
        if value.dim() == 3:  # [out, channels, taps]
            rows = value.permute(2, 1, 0)  # [taps, channels, out]
            moving = {"recognition": value.shape[1]}.get(prefix, 1 if ".0." in name else WIDTH)
            out[name] = rows[:, :moving].reshape(-1, WIDTH)
            if prefix == "decoder":
                constant = rows[:, moving:].permute(1, 0, 2).reshape(-1, 3 * WIDTH)
                out[name.replace("weight", "constant")] = constant
        else:
            out[name] = value.t() if value.dim() == 2 else value
    return {n: {"shape": list(v.shape), "values": numbers(v)} for n, v in out.items()}


def case(activation, residual, seed):
    torch.manual_seed(seed)
    act = {"gelu": F.gelu, "relu": F.relu}[activation]
    recognition, decoder, adversary = Recognition(act, residual), Decoder(act, residual), Adversary(act)
    model = nn.ModuleList([recognition, decoder])
    x, w = torch.randn(BATCH, STEPS, STATE), torch.randn(BATCH, TASK)
    noise = torch.randn(BATCH, LATENTS)
    players = {"recognition": recognition, "decoder": decoder, "adversary": adversary}
    all_named = lambda of: {k: v for p, m in players.items() for k, v in named(p, m, of).items()}

    result = {
        "model": {
            "steps": STEPS, "state_dim": STATE, "task_dim": TASK,
            "network": {
                "latents": LATENTS, "width": WIDTH, "layers": LAYERS,
                "activation": activation, "residual": residual, "task_baseline": False,
            },
        },
        "adversary_width": ADVERSARY, "alpha": ALPHA, "beta": BETA, "learning_rate": LEARNING_RATE,
        "batch": BATCH,
        "x": numbers(x), "w": numbers(w), "noise": numbers(noise),
        "weights": all_named(lambda p: p),
    }

    mean, log_variance = recognition(x)
    h = mean + noise * torch.exp(log_variance / 2)
    x_mean, x_log_variance = decoder(h, w)
    normal = torch.distributions.Normal(x_mean, torch.exp(x_log_variance / 2))
    nll = -normal.log_prob(x).sum()
    posterior = torch.distributions.Normal(mean, torch.exp(log_variance / 2))
    kl = torch.distributions.kl_divergence(posterior, torch.distributions.Normal(0.0, 1.0)).sum(0)
    l1 = F.l1_loss(adversary(mean), w, reduction="sum")
    objective = (nll + BETA * kl.sum() - ALPHA * l1) / BATCH / (STEPS * STATE)
    steps = [
        torch.optim.Adam(model.parameters(), lr=LEARNING_RATE),
        torch.optim.Adam(adversary.parameters(), lr=LEARNING_RATE),
    ]
    objective.backward()
    adversary.zero_grad()
    (F.l1_loss(adversary(mean.detach()), w, reduction="sum") / BATCH).backward()
    result |= {
        "posterior_mean": numbers(mean),
        "posterior_log_variance": numbers(log_variance),
        "h": numbers(h),
        "decoded_mean": numbers(x_mean),
        "decoded_log_variance": numbers(x_log_variance),
        "negative_log_likelihood": nll.item(), "kl": numbers(kl), "adversary": l1.item(),
        "gradients": all_named(lambda p: p.grad),
    }
    for step in steps:
        step.step()
    result["after_one_step"] = all_named(lambda p: p)
    assert math.isfinite(objective.item())
    return result


if __name__ == "__main__":
    cases = [case("gelu", True, 1), case("relu", False, 2)]
    Path(__file__).with_suffix(".json").write_text(json.dumps(cases) + "\n")

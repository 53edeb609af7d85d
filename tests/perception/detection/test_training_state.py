"""Checkpoints of training runs."""

from dataclasses import replace

import pytest
import torch

from perception.detection.training_state import (
    TrainingState,
    mixed_precision,
    resume_checkpoint,
    save_checkpoint,
)
from perception.errors import PerceptionError


def new_state(seed):
    """Return a state of a linear network before its first step."""
    generator = torch.Generator().manual_seed(seed)
    network = torch.nn.Linear(2, 1)
    with torch.no_grad():
        network.weight.copy_(torch.rand(1, 2, generator=generator))
    optimizer = torch.optim.AdamW(network.parameters(), 0.1)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 / (1 + step))
    return TrainingState("config", network, optimizer, schedule, generator)


def step(state):
    """Take one optimisation step on a random input."""
    loss = state.network(torch.rand(4, 2, generator=state.generator)).square().mean()
    state.optimizer.zero_grad()
    loss.backward()
    state.optimizer.step()
    state.schedule.step()


def test_resumed_state_continues_exactly(tmp_path):
    path = tmp_path / "new" / "checkpoint.pt"
    state, resumed = new_state(0), new_state(1)
    step(state)
    save_checkpoint(path, state, 7)
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]
    assert resume_checkpoint(path, resumed) == 7
    for run in (state, resumed):
        step(run)
    for a, b in zip(state.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(a, b)
    assert state.schedule.get_last_lr() == resumed.schedule.get_last_lr() == [pytest.approx(0.1 / 3)]


def test_without_a_checkpoint_training_starts_at_zero(tmp_path):
    state = new_state(0)
    before = state.network.weight.detach().clone()
    assert resume_checkpoint(tmp_path / "checkpoint.pt", state) == 0
    assert torch.equal(state.network.weight, before)


def test_checkpoint_of_another_configuration_is_rejected(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, new_state(0), 1)
    with pytest.raises(
        PerceptionError, match=r"checkpoint\.pt is of another configuration; use another --out"
    ):
        resume_checkpoint(path, replace(new_state(0), config="other"))


@pytest.mark.parametrize(("capability", "dtype"), [({"amx_bf16": True}, torch.bfloat16), ({}, torch.float32)])
def test_bfloat16_is_used_only_where_the_cpu_is_fast_with_it(monkeypatch, capability, dtype):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capability)
    with mixed_precision(torch.device("cpu")):
        assert torch.nn.Linear(2, 1)(torch.ones(1, 2)).dtype is dtype

"""Adam against that of torch."""

import subprocess
import sys

import pytest
import torch

from radiotwin.propagation.laws.adam import Adam

pytestmark = pytest.mark.seconds


def test_it_steps_as_torchs_own_does_also_after_a_stop():
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator) for shape in ((4, 3), (3,))]
    ours = [start.clone() for start in starts]
    theirs = [torch.nn.Parameter(start.clone()) for start in starts]
    adam = Adam(ours, [0.1, 0.0])
    reference = torch.optim.AdamW([{"params": theirs[:1], "weight_decay": 0.1}, {"params": theirs[1:],
                                                                               "weight_decay": 0.0}])
    for step in range(20):
        if step == 10:
            state = adam.state_dict()
            adam = Adam(ours, [0.1, 0.0])
            adam.load_state_dict(state)
        rate = 0.1 / (1 + step)
        gradients = [torch.randn(start.shape, generator=generator) for start in starts]
        adam.step(gradients, rate)
        for parameter, gradient in zip(theirs, gradients):
            parameter.grad = gradient
        for group in reference.param_groups:
            group["lr"] = rate
        reference.step()
    for one, other in zip(ours, theirs):
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-6)


def test_learning_does_not_import_the_compiler():
    code = ("import sys, torch; from radiotwin.propagation.laws.adam import Adam; "
             "Adam([torch.zeros(2)]).step([torch.ones(2)], 0.1); sys.exit('torch._dynamo' in sys.modules)")
    assert subprocess.run([sys.executable, "-c", code], timeout=300).returncode == 0

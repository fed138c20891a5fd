"""Which device work runs on: what is tried, what is refused, and how workers share a GPU. No GPU is needed here."""

import logging
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.runtime import cuda
from radiotwin.runtime.cuda import FREE_SPACE_GAIN_DB
from radiotwin.runtime.execution import LocalPool, Resources
from radiotwin.trace import SolverSettings
from radiotwin.trace.link_job import link_job

GIB = 2**30


@pytest.fixture(autouse=True)
def untried():
    """Forget what was tried."""
    for trial in (cuda.tracing_refusal, cuda.torch_refusal):
        trial.cache_clear()
    yield
    for trial in (cuda.tracing_refusal, cuda.torch_refusal):
        trial.cache_clear()


@pytest.fixture
def traces(monkeypatch):
    """`traces(gain)`: a driver, and a trial link with this gain [dB], or that fails for this reason."""
    def pretend(gain):
        program = f"raise SystemExit({gain!r})" if isinstance(gain, str) else f"print('{gain}')"
        monkeypatch.setattr(cuda, "has_driver", lambda: True)
        monkeypatch.setattr(cuda, "_PROGRAM", program)
    return pretend


@pytest.fixture
def without_driver(monkeypatch):
    monkeypatch.setenv(cuda.DRIVER_VARIABLE, "/nonexistent/libcuda.so.1")

    def trial(device):
        raise AssertionError("there is nothing to try")
    monkeypatch.setattr(cuda, "trace_trial_link", trial)


@pytest.mark.parametrize("choose", [cuda.tracing_device, cuda.torch_device])
def test_without_a_driver_auto_is_the_processor_and_cuda_is_refused(without_driver, choose, caplog):
    with caplog.at_level(logging.INFO):
        assert choose("auto") == choose("cpu") == "cpu"
    assert [record.message for record in caplog.records if "NVIDIA driver" in record.message]
    with pytest.raises(BadInput, match="--device cuda: there is no NVIDIA driver.*radiotwin doctor"):
        choose("cuda")
    with pytest.raises(BadInput, match="allowed are auto, cpu, cuda"):
        choose("d0")


def test_a_gpu_is_taken_where_a_link_is_traced_as_in_free_space(traces):
    traces(FREE_SPACE_GAIN_DB + 0.001)
    assert cuda.tracing_device("auto") == cuda.tracing_device("cuda") == "cuda"
    assert cuda.tracing_device("cpu") == "cpu"


@pytest.mark.parametrize("found, reason", [("OptiX is not there", "OptiX is not there"),
                                           (FREE_SPACE_GAIN_DB - 0.1, "has -80.15 dB"), (float("nan"), "has nan")])
def test_a_gpu_that_does_not_trace_is_not_taken(traces, found, reason):
    traces(found)
    assert cuda.tracing_device("auto") == "cpu"
    with pytest.raises(BadInput, match=reason):
        cuda.tracing_device("cuda")


@pytest.mark.parametrize("ones, used", [(np.ones, "cuda"), (np.zeros, "cpu"), (None, "cpu")])
def test_torch_must_multiply_on_the_gpu(monkeypatch, ones, used):
    """A GPU that is too old for this build of torch is there, but runs nothing."""
    def make(shape, device):
        if ones is None:
            raise RuntimeError("no kernel image\nand more")
        return ones(shape)

    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(
        __version__="9", cuda=SimpleNamespace(is_available=lambda: True), ones=make))
    assert cuda.torch_device("auto") == used
    if ones is None:
        assert "no kernel image" in cuda.torch_refusal() and "more" not in cuda.torch_refusal()


def nvidia_smi(folder, monkeypatch, text):
    tool = folder / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n{text}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def test_as_many_workers_share_a_gpu_as_its_memory_holds(tmp_path, monkeypatch):
    nvidia_smi(tmp_path, monkeypatch, "echo 'Some GPU, 16384, 550.1\nOther GPU, 81920, 550.1\nbroken'")
    assert [gpu.memory_bytes / GIB for gpu in cuda.gpus()] == [16, 80]
    for memory_bytes, workers in ((3 * GIB, 5), (16 * GIB, 1), (40 * GIB, 1), (GIB * 16 // 7, 7)):
        share = cuda.share_of_gpu(memory_bytes)
        assert share * workers <= 1 < share * (workers + 1) + 1e-3
        assert share == round(share, 4)  # Ray's unit
    assert cuda.share_of_gpu(0) == 1.0
    nvidia_smi(tmp_path, monkeypatch, "exit 9")
    assert cuda.gpus() == [] and cuda.share_of_gpu(GIB) == 1.0


def test_the_job_of_a_trace_asks_for_its_share(small_scene, tmp_path, monkeypatch):
    nvidia_smi(tmp_path, monkeypatch, "echo 'Some GPU, 16384, 550.1'")
    settings = SolverSettings.of_quality("default", compute_device="cuda")
    assert link_job(small_scene, settings, "").resources.gpu_share == pytest.approx(1 / 5)
    assert link_job(small_scene, SolverSettings(), "").resources.gpu_share == 0


def test_workers_of_this_machine_share_one_gpu():
    pool = LocalPool(4)
    with pytest.raises(RunFailed, match="4 workers are asked for, and 3 share a GPU"):
        pool.prepare(b"", Resources(gpu_share=0.3333), 10)
    assert len(pool.prepare(b"", Resources(gpu_share=0.25), 10)) == 4
    assert len(pool.prepare(b"", Resources(gpu_share=1.0), 1)) == 1  # no more workers than pieces
    pool.close()
    assert LocalPool().prepare(b"", Resources(gpu_share=1.0), 10) == []  # this process is as fast


def test_the_device_is_among_what_decides_a_gain_but_for_the_processor():
    cpu, gpu = (SolverSettings(compute_device=name).attributes() for name in ("cpu", "cuda"))
    assert gpu == cpu | {"compute_device": "cuda"} and "compute_device" not in cpu
    with pytest.raises(BadInput, match="compute_device = 'metal'"):
        SolverSettings(compute_device="metal")


@pytest.mark.llvm
def test_one_process_traces_on_one_device():
    from radiotwin.trace.solver import import_sionna, load_city

    import_sionna()
    with pytest.raises(RunFailed, match="llvm_ad_mono_polarized in this process already"):
        load_city(None, 2.4e9, "cuda")

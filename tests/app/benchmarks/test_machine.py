"""Description of the machine."""

import platform

from app.benchmarks.machine import _processor, describe_machine


def test_the_machine_is_named():
    machine = describe_machine("cpu")
    assert machine["processor"] and machine["cores"] >= 1 and machine["cuda"] is None
    assert {"python", "nodeslam", "torch", "warp-lang"} <= machine.keys()


def test_the_processor_comes_from_cpuinfo(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nmodel name\t: Some CPU @ 2 GHz\nmodel name\t: Other\n")
    assert _processor(cpuinfo) == "Some CPU @ 2 GHz"
    assert _processor(tmp_path / "none") == (platform.processor() or platform.machine())

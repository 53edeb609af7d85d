"""CUDA without a GPU: Warp's generated CUDA source of every kernel, compiled to machine code by its NVRTC.

Compilation needs neither device nor driver. It fails where the source uses something that CUDA does not have;
it runs nothing.
"""

import ast
import importlib
import struct
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from perception.warp_runtime import start_warp

ROOT = Path(__file__).parents[2]
PACKAGES = ("app", "perception", "manipulation", "sim_assets")
ARCHITECTURES = (75, 80, 90)  # Turing, the oldest that CUDA 13 supports, Ampere and Hopper
ELF_MACHINE_CUDA = 190


def _makes_kernel(decorator: ast.expr) -> bool:
    return ast.unparse(decorator).partition("(")[0] in ("wp.kernel", "warp.kernel")


def _kernels() -> dict[str, set[str]]:
    """Return the names of the kernels of each module that has any."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
            names = {f.name for f in functions if any(map(_makes_kernel, f.decorator_list))}
            if names:
                found[".".join(path.relative_to(ROOT).with_suffix("").parts)] = names
    return found


KERNELS = _kernels()


@pytest.fixture(scope="module", autouse=True)
def _nvrtc() -> None:
    start_warp()
    if wp.get_cuda_supported_archs() == []:
        pytest.skip("this build of Warp has no NVRTC")


def _compile(module: Any, architecture: int, folder: Path) -> tuple[bytes, str]:
    """Return the machine code of all kernels of a module, and the generated CUDA source."""
    (binary,) = wp.compile_aot_module(module, arch=architecture, module_dir=folder, use_ptx=False)
    return binary.read_bytes(), next(folder.glob("*.cu")).read_text(encoding="utf-8")


def test_the_kernels_of_renderers_and_decoder_are_found() -> None:
    assert {"perception.rendering.kernel", "perception.shape.sparse_kernels"} <= set(KERNELS)
    assert sum(map(len, KERNELS.values())) >= 12


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_compile_to_machine_code(name, architecture, tmp_path) -> None:
    binary, source = _compile(importlib.import_module(name), architecture, tmp_path / "aot")
    assert binary[:4] == b"\x7fELF" and struct.unpack_from("<H", binary, 18) == (ELF_MACHINE_CUDA,)
    for kernel in KERNELS[name]:
        assert f"void {kernel}_" in source  # the entry point, with a hash
        assert f"{kernel}_".encode() in binary


@wp.func_native("return __builtin_ia32_rdtsc() > 0 ? x : 0.0f;")
def processor_clock(x: float) -> float: ...


@wp.kernel(module="unique")
def cpu_only_kernel(values: wp.array(dtype=wp.float32)):  # pyright: ignore[reportInvalidTypeForm]
    values[wp.tid()] = processor_clock(values[wp.tid()])


def test_an_instruction_of_the_cpu_alone_is_an_error(tmp_path, capfd) -> None:
    values = wp.full(3, 2.0, dtype=wp.float32, device="cpu")
    wp.launch(cpu_only_kernel, dim=3, inputs=[values], device="cpu")
    assert values.numpy().tolist() == [2.0, 2.0, 2.0]
    with pytest.raises(Exception, match="CUDA kernel build failed"):
        _compile(cpu_only_kernel.module, 80, tmp_path / "aot")
    assert "__builtin_ia32_rdtsc" in "".join(capfd.readouterr())

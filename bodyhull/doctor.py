"""`bodyhull doctor`: what this machine has, and whether the parts that break most often really work."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from bodyhull.carving import software


@dataclass(frozen=True)
class Finding:
    """One line: what, what was found, and whether the pipeline can live with it."""

    name: str
    value: str
    good: bool = True


def findings() -> list[Finding]:
    """Look at Python, packages, OpenGL (a triangle is really drawn), cores, memory, disk, JAX devices, the
    body cache."""
    out = [
        Finding(
            "python", f"{platform.python_version()} on {platform.platform()}", sys.version_info >= (3, 11)
        ),
    ]
    for name, version in software().items():
        if name != "python":
            out.append(Finding(name, version, version != "missing"))
    out.append(_opengl())
    out.append(Finding("cores", f"{_cores()} usable of {os.cpu_count()}"))
    out.append(_memory())
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    out.append(Finding("free disk here", f"{free:.1f} GB", free > 2))
    out.append(_jax())
    out.append(_video())
    return out


def _opengl() -> Finding:
    from render.gl import probe

    report = probe()
    if report.problem is not None:
        return Finding("OpenGL off-screen", report.problem, False)
    return Finding(
        "OpenGL off-screen", f"{report.platform}: {report.renderer} ({report.version}) drew a triangle"
    )


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory() -> Finding:
    try:
        pages, size = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
        total = pages * size / 1e9
    except (ValueError, OSError):
        return Finding("memory", "unknown on this system")
    return Finding("memory", f"{total:.1f} GB", total > 4)


def _jax() -> Finding:
    try:
        from fit.jax_setup import setup_jax

        setup_jax()
        import jax

        devices = jax.devices()
        kinds = ", ".join(f"{d.platform}:{d.device_kind}" for d in devices)
    except Exception as error:  # a broken driver raises whatever it likes; the doctor must tell, not fall ill
        return Finding("JAX", f"{type(error).__name__}: {error}", False)
    gpu = (
        "a GPU is there"
        if any(d.platform != "cpu" for d in devices)
        else "no GPU: everything runs on the CPU"
    )
    return Finding("JAX devices", f"{kinds} ({gpu})")


def _video() -> Finding:
    try:
        import av

        av.codec.Codec("libx264", "w")
    except Exception as error:  # PyAV's own error types differ between versions
        return Finding("H.264 encoder", f"{type(error).__name__}: {error}; reinstall the package av", False)
    return Finding("H.264 encoder", "libx264")


def print_findings(found: list[Finding]) -> bool:
    """Print one line each; true where all is well."""
    for finding in found:
        print(f"{'ok ' if finding.good else 'BAD'}  {finding.name:<32}{finding.value}")
    return all(f.good for f in found)

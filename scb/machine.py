"""What numbers were computed with, and on what: versions of packages, and the machine."""

import os
import platform
import subprocess
import sys
from importlib import metadata as distributions
from pathlib import Path

import jax

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "evosax", "gymnax", "brax", "numpy", "lpo")


# What JAX is told about numbers, and how it is told nothing.
_ARITHMETIC = {
    "jax_enable_x64": False,
    "jax_default_prng_impl": "threefry2x32",
    "jax_threefry_partitionable": True,
}


def arithmetic() -> dict[str, str]:
    """JAX's precision and random numbers where they are not its defaults: agents of one seed then differ."""
    told = {name: getattr(jax.config, name) for name in _ARITHMETIC}
    return {name: str(value) for name, value in told.items() if value != _ARITHMETIC[name]}


def package_versions() -> dict[str, str]:
    """Versions of Python, of what decides the numbers, and of this project ("lpo")."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = distributions.version(package)
        except distributions.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def machine_description() -> dict[str, str | int]:
    """What timings depend on: processor, cores, accelerator, platform; no host name and no path."""
    devices = jax.devices()
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "accelerator": devices[0].device_kind if devices[0].platform != "cpu" else "none",
        "jax_platform": devices[0].platform,
        "jax_devices": len(devices),
        "platform": f"{platform.system()} {platform.machine()}",
    }


def usable_cores() -> int:
    """Cores that this process may use, which in a container or a batch system are fewer than the machine's."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    if sys.platform.startswith("linux"):
        try:
            lines = Path("/proc/cpuinfo").read_text().splitlines()
        except OSError:
            lines = []
        for line in lines:
            key, _, value = line.partition(":")
            if key.strip().lower() in ("model name", "hardware"):
                return value.strip()
    if sys.platform == "darwin":
        answer = subprocess.run(
            ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"],
            capture_output=True,
            text=True,
            check=False,
        )
        if answer.returncode == 0:
            return answer.stdout.strip()
    return platform.processor() or platform.machine() or "unknown"

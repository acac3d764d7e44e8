"""What pyproject.toml cannot say: the kernels in the wheel, and the README of a package index.

A wheel carries its kernels, compiled for any x86-64 processor of level 3: no run compiles. With
EPIPOLE_COMPILE=0, and on another machine, it has none; then each machine compiles once.

An index has neither the picture nor the files that the README links. So links to files become
their names, with the path where the name does not tell it, and the picture is left out. With the
address of a public repository they could be whole links; there is none yet.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent

LINK = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


def text_of(link: re.Match[str]) -> str:
    """Return a link as it is if it leads to the web, else its name and path."""
    name, target = link.groups()
    if "://" in target:
        return link[0]
    path = target.partition("#")[0]
    return name if "`" in name or name == path else f"{name} (`{path}`)"


def index_page(readme: str) -> str:
    """Return the README without picture, marks and links to files."""
    text = re.sub(r"^!\[.*\n\n|^<!-- .* -->\n", "", readme, flags=re.MULTILINE)
    return LINK.sub(text_of, text)


def why_no_kernels() -> str | None:
    """Return why this wheel carries no kernels. None: it does."""
    if os.environ.get("EPIPOLE_COMPILE") == "0":
        return "EPIPOLE_COMPILE=0"
    path = ROOT / "io" / "caches" / "kernel_target.py"
    spec = importlib.util.spec_from_file_location("kernel_target", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if module.common_target() is None:
        return "this is no x86-64 processor of level 3 (AVX2)"
    return None


class WheelOfThisPython(Distribution):
    """With kernels, a wheel is for one version of Python and one kind of machine."""

    def has_ext_modules(self) -> bool:
        """Return whether the wheel has compiled code."""
        return super().has_ext_modules() or why_no_kernels() is None


class BuildWithKernels(build_py):
    """The modules, and the kernels that are compiled from these copies."""

    def run(self) -> None:
        """Build them. An editable install compiles in its first run: its code changes."""
        super().run()
        if self.editable_mode:
            return
        reason = why_no_kernels()
        if reason is None:
            reason = self.compile_kernels()
        if reason is not None:
            print(f"no compiled kernels in this wheel: {reason}; a first run compiles", flush=True)

    def compile_kernels(self) -> str | None:
        """Compile, with two processes, for a minute or two. Return the reason if it fails."""
        print("compiling kernels for a minute or two", flush=True)
        code = Path(self.build_lib).resolve()
        paths = [str(code), os.environ.get("PYTHONPATH", "")]
        into = code / "epipole" / "io" / "caches" / "compiled"
        command = [sys.executable, "-m", "epipole.io.caches.kernel_compiler", "--into", str(into)]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        done = subprocess.run(command, env=env, cwd=code, check=False)
        return None if done.returncode == 0 else "the compiler failed, see above"


setup(
    cmdclass={"build_py": BuildWithKernels},
    distclass=WheelOfThisPython,
    long_description=index_page((ROOT / "README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)

"""What setup.cfg cannot say: a wheel without the developers' programs, and a README whose links lead somewhere.

Who publishes says where the repository is: BLINKGL_URL=https://… python -m build."""

import os
import re
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

URL = os.environ.get("BLINKGL_URL", "").rstrip("/")
DEVELOPERS = "blinkgl.tools"


class BuildPy(build_py):
    """Leaves out the programs that only developers run; an editable install has them."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        found = super().find_package_modules(package, package_dir)
        return found if package != DEVELOPERS else [module for module in found if module[1] == "__init__"]


def long_description() -> str:
    """The README; with a URL its relative links and images lead to files of the repository."""
    text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    if not URL:
        return text
    text = re.sub(r"!\[([^]]*)\]\((?!https?:)", rf"![\1]({URL}/raw/HEAD/", text)
    return re.sub(r"(?<!!)\[([^]]*)\]\((?!https?:|#)", rf"[\1]({URL}/blob/HEAD/", text)


PAGES = {"Source": "", "Documentation": "/blob/HEAD/docs/index.md", "Changelog": "/blob/HEAD/CHANGELOG.md"}
setup(
    cmdclass={"build_py": BuildPy},
    long_description=long_description(),
    project_urls={name: URL + page for name, page in PAGES.items()} if URL else {},
)

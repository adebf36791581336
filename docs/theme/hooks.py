"""What mkdocs needs to make one site of this repository, whose pages also lie beside what they describe.

The cards of arms and policies and the changelog become pages of the site, and links between all pages lead to the place
that a page has in the site. A link to source code, which the site has no page for, becomes plain text.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
CARDS = ("arms/*/README.md", "policies/README.md", "policies/*/README.md", "CHANGELOG.md", "CONTRIBUTING.md")
SHOWN = (".png", ".webp", ".gif", ".mp4")
"""What the folder of a card holds for the eye."""
LINK = re.compile(r"^```.*?^```|(!?)\[([^\]]*)\]\(([^)\s]+)\)|`[^`\n]+`", re.DOTALL | re.MULTILINE)
"""A link, or code, in which nothing is a link; whichever begins first."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie outside of docs/, with their pictures and films."""
    for pattern in CARDS:
        for page in sorted(ROOT.glob(pattern)):
            beside = [] if page.parent == ROOT else sorted(page.parent.iterdir())
            for path in [page, *(path for path in beside if path.suffix in SHOWN)]:
                files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links of the repository into links of the site, outside of code."""
    here = page.file.src_uri
    outside = any(Path(here).match(pattern) for pattern in CARDS)
    source = here if outside else posixpath.join("docs", here)

    def site_link(match: re.Match[str]) -> str:
        mark, text, target = match.groups()
        path, hash_, anchor = (target or "").partition("#")
        if not path or ":" in target:  # code, a heading of this page, or another site
            return match[0]
        repository = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        found = in_site(repository, files)
        if found is None:  # source code; or a mistake, which mkdocs finds
            return text if (ROOT / repository).exists() else match[0]
        link = posixpath.relpath(found, posixpath.dirname(here) or ".")
        if link.endswith(".mp4"):
            title = text.replace("`", "")
            return f'<video src="{link}" title="{title}" controls loop muted playsinline preload="metadata"></video>'
        return f"{mark}[{text}]({link}{hash_}{anchor})"

    return LINK.sub(site_link, markdown)


def in_site(path: str, files: Files) -> str | None:
    """Return the site's source of a path of the repository, None if the site does not have it."""
    uri = path.removeprefix("docs/")
    for candidate in (uri, posixpath.join(uri, "README.md"), posixpath.join(uri, "index.md")):
        if files.get_file_from_path(candidate) is not None:
            return candidate
    return None

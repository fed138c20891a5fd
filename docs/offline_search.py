"""Hook of the site: the search opens no network, also where a page is opened from a file."""

import re
from typing import Any

FROM_NETWORK = re.compile(r'<script src="https://unpkg\.com/iframe-worker/[^"]*"></script>')


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Replace the script that the plugin `offline` would load from the network by our own."""
    return _with_own(output, "../" * page.url.count("/"))


def on_post_template(output_content: str, template_name: str, config: Any) -> str:
    """Do the same in pages that are no pages of the documentation, such as 404.html."""
    return _with_own(output_content, "")


def _with_own(html: str, root: str) -> str:
    return FROM_NETWORK.sub(f'<script src="{root}search-from-file.js"></script>', html)

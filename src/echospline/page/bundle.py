"""The page as one file: modules in one script, style, core and scene inside, under a policy that lets nothing else run or leave."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable
from importlib.resources import files

from echospline.errors import InputError
from echospline.page.pack import Pack, deflated

CORE, CORE_SCRIPT = "echospline.wasm", "echospline.js"
_IMPORT = re.compile(r'^import\s+(?:\{([^}]*)\}\s+from\s+)?"(\./[\w./-]+\.js)";?[ \t]*$', re.MULTILINE)
_EXPORT = re.compile(r"^export\s+(?=(?:async\s+)?(?:function|class|const|let)\b)", re.MULTILINE)
_DECLARED = re.compile(r"(?:async\s+)?(?:function\*?|class|const|let|var)\s+([A-Za-z_$][\w$]*)")
_TOP = re.compile(f"^{_DECLARED.pattern}", re.MULTILINE)
_NAME = re.compile(r"[A-Za-z_$][\w$]*")
_STYLE_TAG, _SCRIPT_TAG = (
    '<link rel="stylesheet" href="style.css">',
    '<script type="module" src="main.js"></script>',
)
_CHARSET = '<meta charset="utf-8">'
SERVED = '<meta name="echospline-server" content="1">'
"""In a page that comes from a server."""


def bundle(pack: Pack) -> str:
    """Return the page of a scene as one file.

    Parameters
    ----------
    pack : Pack
        The scene.

    Raises
    ------
    InputError
        If the core in WebAssembly has not been built.
    """
    html, _ = assembled(shipped, {"core": core_bytes(), "scene": pack.to_bytes()}, pack.manifest.language)
    return html


def served_page(language: str = "en") -> tuple[str, str]:
    """Return the page that a server serves, without core and scene, and its policy: the page fetches them from its own server.

    Parameters
    ----------
    language : str
        Of the page, two letters.
    """
    return assembled(shipped, {}, language, served=True)


def core_bytes() -> bytes:
    """Return the core in WebAssembly.

    Raises
    ------
    InputError
        If it has not been built.
    """
    core = files("echospline").joinpath("_native", CORE)
    if not core.is_file():
        raise InputError(
            "the page needs the core in WebAssembly, which this installation lacks: make wasm in a checkout, or install a wheel "
            "(or with ECHOSPLINE_WASM=1)"
        )
    return core.read_bytes()


def shipped(name: str) -> str:
    """Read a file of the page: its own, or the core's script.

    Raises
    ------
    InputError
        If there is none of this name.
    """
    for folder in ("page/static", "_native"):
        path = files("echospline").joinpath(*folder.split("/"), name)
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"the page has no file {name}")


def assembled(
    read: Callable[[str], str], data: dict[str, bytes], language: str = "en", *, served: bool = False
) -> tuple[str, str]:
    """Assemble a page from its files and data; returns it and its policy.

    Parameters
    ----------
    read : callable
        From the name of a file to its text: index.html, style.css, main.js and what that imports.
    data : dict of str to bytes
        By the id of the element that holds it, deflated and in base64.
    language : str
        Of the page, two letters.
    served : bool
        Whether it comes from a server, which it may then ask: it says so by its ``echospline-server``.

    Raises
    ------
    InputError
        If the files cannot be put into one script.
    """
    script, style, html = (one_script(read, "main.js"), _plain(read("style.css")), _plain(read("index.html")))
    for tag in (_STYLE_TAG, _SCRIPT_TAG, _CHARSET):
        if html.count(tag) != 1:
            raise InputError(f"index.html must hold {tag} once; it has it {html.count(tag)} times")
    if re.search(r"\son\w+\s*=|\sstyle\s*=|javascript:", html, re.IGNORECASE):
        raise InputError(
            "index.html may hold no inline handlers and no inline styles: the page's policy refuses them"
        )
    if "</style" in style.lower():
        raise InputError("style.css may not hold </style")
    script, style = f"\n{script}", f"\n{style}"
    rules = policy(script, style, served=served)
    meta = f'<meta http-equiv="Content-Security-Policy" content="{rules}">'
    if served:
        meta += f"\n{SERVED}"
    blocks = [
        f'<script type="text/plain" id="{name}">{_base64(deflated(part))}</script>'
        for name, part in data.items()
    ]
    html = re.sub(r"<html\b[^>]*>", f'<html lang="{language}">', html, count=1)
    html = html.replace(_CHARSET, f"{_CHARSET}\n{meta}")
    html = html.replace(_STYLE_TAG, f"<style>{style}</style>")
    return html.replace(_SCRIPT_TAG, "\n".join([*blocks, f'<script type="module">{script}</script>'])), rules


def policy(script: str, style: str, *, served: bool = False) -> str:
    """Return the policy of a page with this inline script and style: nothing else runs, is loaded or sent, but to its own server."""
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src '{_hash(script)}' 'wasm-unsafe-eval'",
            "worker-src blob:",
            f"style-src '{_hash(style)}'",
            "img-src data: blob:",
            "media-src blob:",
            "base-uri 'none'",
            "form-action 'none'",
            *(["connect-src 'self'"] if served else []),
        ]
    )


def one_script(read: Callable[[str], str], first: str) -> str:
    """Put a module and all that it imports into one script, each after what it imports.

    Modules import names as they are, from files beside them (`import { a, b } from "./scene.js";`), and export declarations. A name at the
    top of one module may not be one of another.

    Raises
    ------
    InputError
        If a module imports or exports in another way, imports itself, or two declare one name.
    """
    order: list[str] = []
    texts: dict[str, str] = {}
    _collect(read, first, (), order, texts)
    owner: dict[str, str] = {}
    exported: dict[str, set[str]] = {}
    parts = []
    for name in order:
        text = texts[name]
        found_ = (_DECLARED.match(text, m.end()) for m in _EXPORT.finditer(text))
        exported[name] = {declared.group(1) for declared in found_ if declared is not None}
        for names, source in _IMPORT.findall(text):
            missing = {n.strip() for n in names.split(",") if n.strip()} - exported[_base(source)]
            if missing:
                raise InputError(
                    f"{name} imports {', '.join(sorted(missing))} from {_base(source)}, which does not export it"
                )
        text = _EXPORT.sub("", _IMPORT.sub("", text))
        left = re.search(r"^\s*(?:import|export)\b.*$", text, re.MULTILINE)
        if left is not None:
            raise InputError(
                f"{name} imports or exports in a way that one script has no room for: {left.group().strip()[:80]}"
            )
        for found in _TOP.findall(text):
            if found in owner:
                raise InputError(
                    f"{name} and {owner[found]} both declare {found}: names at the top of modules must differ"
                )
            owner[found] = name
        parts.append(f"// {name}\n{text.strip()}\n")
    script = "\n".join(parts)
    if "</script" in script.lower() or "<!--" in script:
        raise InputError("a script in a page may hold neither </script nor <!--")
    return script


def _collect(
    read: Callable[[str], str], name: str, path: tuple[str, ...], order: list[str], texts: dict[str, str]
) -> None:
    """Add a module and all that it imports, deepest first."""
    if name in path:
        raise InputError(f"modules import each other in a circle: {' -> '.join([*path, name])}")
    if name in order:
        return
    text = _plain(read(name))
    for names, source in _IMPORT.findall(text):
        for item in names.split(","):
            if item.strip() and not _NAME.fullmatch(item.strip()):
                raise InputError(
                    f"{name} imports {item.strip()!r}: a page's modules import names as they are"
                )
        _collect(read, _base(source), (*path, name), order, texts)
    texts[name] = text
    order.append(name)


def _base(source: str) -> str:
    return source.rsplit("/", 1)[-1]


def _plain(text: str) -> str:
    """Return text with newlines alone at the ends of lines: the policy's hash covers every byte."""
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()

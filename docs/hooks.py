"""What the site has beside the pages here: front page, changelog, command line, notebooks, equations as MathML.

mkdocs calls the functions named ``on_…``. Nothing here or in the pages reads the network: `on_post_build` checks it.
"""

import functools
import re
import unicodedata
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
#: Files of the top folder that are pages of the site.
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
#: Keys of cited works in brackets, as in [kirk1991] or [salmon2011, wellons2018].
CITED = re.compile(r"(?<!\])\[([a-z]+\d{4}[a-z]?(?:, [a-z]+\d{4}[a-z]?)*)\](?![(\[])")
#: A symbol of one letter, with a hat or without, and an index.
INDEXED = re.compile(r"(?<![\w/.:])([A-Za-zΔΘΛΣΦΨΩαβγδηθκλμνρσςτφχψωϱ]\u0302?)_([A-Za-z0-9]+)(?![A-Za-z0-9_/])")
#: Characters of a cell from which a table does not fit on a telephone.
LONG_CELL = 40
#: Letters of a word that is a key: the column beside it would be too narrow on a telephone.
LONG_WORD = 18
#: A word of code with a hyphen, or the path of a file, at whose signs a browser would cut it.
CUT_CODE = re.compile(r"(?<![^ ])(?:(?=[^ ]*-)[^ ]{2,%d}|(?=[\w.]+/)[\w./-]{2,32})(?![^ ])" % LONG_WORD)
#: The same in a block of commands, between what marks the spaces.
OPTION = re.compile(r"(?<=[\s>])(?=[\w-]*-)[\w-]{2,24}(?=[\s<])")
#: A match that is not cut at the end of a line.
WHOLE = r"<span class=whole>\g<0></span>"
#: Where docs/cli.md is to have what `--help-all` says of each command.
COMMANDS = "<!-- commands -->"


def on_config(config: Any) -> Any:
    """Equations stand in fences called ``math``, which GitHub draws as well."""
    fences = config.mdx_configs.setdefault("pymdownx.superfences", {}).setdefault("custom_fences", [])
    fences.append({"name": "math", "class": "equation", "format": equation})
    return config


def equation(source: str, *_: Any, **__: Any) -> str:
    """LaTeX as MathML, which browsers draw without a script; lines of ``gathered`` are equations of their own."""
    from latex2mathml.converter import convert

    rows = (line.strip().removesuffix("\\\\") for line in source.split("\n"))
    lines = [convert(row, display="block") for row in rows if row and not re.match(r"\\(begin|end)\{gathered\}", row)]
    # a bar is a bracket here, not a relation with space around it
    whole = "".join(lines).replace("<mo>&#x0007C;</mo>", '<mo lspace="0" rspace="0">&#x0007C;</mo>')
    return f'<div class="equation">{whole}</div>'


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not written in this folder."""
    for name, page in PAGES.items():
        wide = "---\nhide: [toc]\n---\n\n" if page == "index.md" else ""  # its commands need the width
        files.append(File.generated(config, page, content=wide + moved((ROOT / name).read_text(encoding="utf-8"))))
    files.append(File.generated(config, "references.md", content=bibliography()))
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            files.remove(file)
            add_notebook(Path(file.abs_src_path), file.src_uri.removesuffix(".ipynb"), files, config)
    return files


def moved(text: str) -> str:
    """The text with the links that are right from the site's root."""
    text = re.sub(r"\]\(docs/", "](", text)
    for name, page in PAGES.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text.replace("[CITATION.cff](CITATION.cff)", "`CITATION.cff`")


def add_notebook(path: Path, name: str, files: Files, config: Any) -> None:
    """Add a notebook as a page, with its stored pictures beside it."""
    from nbconvert import MarkdownExporter

    text, resources = MarkdownExporter().from_filename(str(path), resources={"unique_key": path.stem})
    text = re.sub(r"^!\[png\]\(", "![Output of the cell above](", text, flags=re.MULTILINE)
    files.append(File.generated(config, f"{name}.md", content=text))
    for picture, data in resources["outputs"].items():
        files.append(File.generated(config, f"{name.rpartition('/')[0]}/{picture}", content=data))


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put the commands with their options into the page of the command line, and links to cited works."""
    if page.file.src_uri == "cli.md":
        markdown = markdown.replace(COMMANDS, commands())
    above = "../" * page.file.src_uri.count("/")
    works = set(entries())

    def linked(match: re.Match) -> str:
        keys = match.group(1).split(", ")
        if not works.issuperset(keys):
            return match.group(0)
        return "[" + ", ".join(f"[{key}]({above}references.md#{key})" for key in keys) + "]"

    # symbols with an index in the text, as in I_e; GitHub shows them as they are written
    pieces = re.split(r"(^```.*?^```$|`[^`\n]*`|\]\([^)]*\)|^    [^\n]*$)", markdown, flags=re.MULTILINE | re.DOTALL)
    pieces[::2] = (INDEXED.sub(r"\1<sub>\2</sub>", piece) for piece in pieces[::2])
    markdown = "".join(pieces)
    return CITED.sub(linked, re.sub(r"(\]\([^)]*)\.ipynb\)", r"\1.md)", markdown))


def on_page_content(html: str, **_: Any) -> str:
    """Fold the tests of equations; for narrow screens, name cells of tables with long text, keep short code whole."""

    def named(table: re.Match) -> str:
        heads = [plain_text(head) for head in re.findall(r"<th[^>]*>(.*?)</th>", table.group(0), re.DOTALL)]
        cells = re.findall(r"<td[^>]*>(.*?)</td>", table.group(0), re.DOTALL)
        has_keys = len(heads) == 2 and any(
            "<code>" in cell or max(map(len, plain_text(cell).split()), default=0) > LONG_WORD for cell in cells[::2]
        )
        if not (len(heads) > 2 or has_keys) or not any(len(plain_text(cell)) > LONG_CELL for cell in cells):
            return table.group(0)
        count = iter(range(len(cells)))
        label = lambda match: f'<td data-label="{heads[next(count) % len(heads)]}"{match.group(1)}>'  # noqa: E731
        return re.sub(r"<td([^>]*)>", label, table.group(0)).replace("<table", "<table data-long", 1)

    folded = r"<details class=tests><summary>Checked by tests</summary>\1</details>"
    html = re.sub(r"<p><em>Checked by</em> (.*?)</p>", folded, html, flags=re.DOTALL)
    html = re.sub(r"<table>.*?</table>", named, html, flags=re.DOTALL)
    html = re.sub(r"<code>([^<>\n]+)</code>", whole_words, html)
    options = lambda block: OPTION.sub(WHOLE, block.group(0))  # noqa: E731
    return re.sub(r'<div class="language-bash.*?</div>', options, html, flags=re.DOTALL)


def whole_words(code: re.Match) -> str:
    """Code in a line of text whose short words are not cut: ``--roi`` at its hyphens, a path, or a name in a table."""
    text = code.group(1)
    if len(text) <= LONG_WORD:
        return f"<code class=whole>{text}</code>"
    return "<code>" + CUT_CODE.sub(WHOLE, text) + "</code>"


def plain_text(html: str) -> str:
    """The text of a piece of a page, for an attribute."""
    return re.sub(r"<[^>]*>", "", html).strip().replace('"', "&quot;")


@functools.cache
def entries() -> dict[str, dict[str, str]]:
    """The fields of each work in references.bib, by key."""
    text = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
    found = re.findall(r"^@\w+\{(\w+),\n(.*?)^\}", text, re.MULTILINE | re.DOTALL)
    field = re.compile(r"(\w+) = \{(.*?)\},?\s*(?=\w+ = \{|\Z)", re.DOTALL)
    return {key: {name: plain(" ".join(value.split())) for name, value in field.findall(body)} for key, body in found}


def plain(text: str) -> str:
    """LaTeX of a bibliography as text."""
    accents = {"'": "\u0301", '"': "\u0308", "`": "\u0300", "^": "\u0302", "~": "\u0303", "v": "\u030c", "c": "\u0327"}
    text = re.sub(r"\{?\\(['\"`^~vc])\{?(\w)\}?\}?", lambda m: m.group(2) + accents[m.group(1)], text)
    text = text.replace("\\textmu", "µ").replace("--", "–").replace("\\&", "&").replace("~", " ")
    return unicodedata.normalize("NFC", re.sub(r"[{}]", "", text))


def bibliography() -> str:
    """The page of cited works, in order of their keys."""
    lines = ["# Cited works", "", "Papers are cited by key. `docs/references.bib` is the same list for BibTeX.", ""]
    for key, work in sorted(entries().items()):
        where = work.get("journal") or work.get("booktitle") or work.get("publisher") or work.get("institution") or ""
        names = ", ".join(" ".join(reversed(name.split(", "))) for name in work["author"].split(" and "))
        volume = work.get("volume", "") + (f"({work['number']})" if "number" in work else "")
        place = ", ".join(part for part in (where, volume, work.get("pages", ""), work["year"]) if part)
        doi = f" [doi:{work['doi']}](https://doi.org/{work['doi']})" if "doi" in work else ""
        lines += [f"### {key}", "", f"{names}: *{work['title']}*. {place}.{doi}", ""]
    return "\n".join(lines)


def commands() -> str:
    """What `--help-all` says of every command, as Markdown."""
    from hesim_render.cli.commands import program
    from hesim_render.cli.options import full_help

    def section(name: str, command: Any) -> list[str]:
        width = 90  # as many letters as fit beside the table of contents
        context = command.context_class(
            command, info_name=f"hesim-render {name}", terminal_width=width, max_content_width=width
        )
        lines = [f"### {name}", "", "```text", full_help(context).strip(), "```", ""]
        for below, child in getattr(command, "commands", {}).items():
            lines += section(f"{name} {below}", child)
        return lines

    visible = ((name, command) for name, command in program().commands.items() if not command.hidden)
    return "\n".join(line for name, command in visible for line in section(name, command))


def on_post_build(config: Any) -> None:
    """Refuse a site whose pages load anything from elsewhere."""
    loads = re.compile(r"<(?:script|img|iframe|source|link)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\"' >]+)")
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        found = loads.findall(path.read_text(encoding="utf-8"))
        if found:
            raise PluginError(f"{path.relative_to(config.site_dir)} loads {found[0]}")

"""What the site needs beyond its pages: copies, notebooks, a picture of the imports, formulas."""

import html
import re
from pathlib import Path

import browser  # beside this file
import layers
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parents[2]
TOP = re.findall(r"from \.(\w+\.\w+) import (\w+)", (ROOT / "afm_rl/__init__.pyi").read_text())
LINK = re.compile(r"(?<!!)\[([^]]+)\]\(([^):]+)\)")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
# The parts of the API page: packages with an __all__, and names of single modules.
API = {
    "Wrappers, comparison, check of a model": [
        f"{module}.{name}" for module, name in TOP if name != "ActionFlowTransform"
    ],
    "Transforms and policies": "transforms",
    "Correction": "correction",
    "Planning": "planning",
    "Dynamics": "dynamics",
    "Learning": "learning",
    "Regimes": "regimes",
    "Diagnosis": "diagnosis",
    "What a check says": [
        f"diagnosis.model_check.{x}" for x in ("ModelCheck", "check_transitions")
    ],
    "Environments": "envs",
    "Missions": "missions",
    "Reports": "report",
    "Foundations": [
        "spaces.manifold.Manifold",
        "streams.Streams",
        "storage.artefacts.save_artefact",
        "storage.artefacts.load_artefact",
        "storage.manifest.write_manifest",
        "storage.manifest.check_manifest",
    ],
}
# Pages of the site that are kept elsewhere, because people look for them there.
COPIES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "afm_rl/correction/README.md": "mathematics.md",
}


def with_site_links(text):
    """Point links of files in the root to the pages of the site; others become plain text."""

    def link(found):
        words, target = found.groups()
        path, hash_, anchor = target.partition("#")
        if path in COPIES:
            path = COPIES[path]
        elif path.startswith("docs/"):
            path = path.removeprefix("docs/")
        elif path.endswith(".ipynb"):
            path = path.replace(".ipynb", ".md")
        else:
            return words
        return f"[{words}]({path}{hash_}{anchor})"

    return LINK.sub(link, text).replace("](docs/", "](")


def api_page():
    """Return the page that lists every public part."""
    parts = ["# API", "Every public part, by package."]
    for title, names in API.items():
        if isinstance(names, str):
            package = names
            path = ROOT / ("" if package == "envs" else "afm_rl") / package / "__init__.pyi"
            public = re.findall(r" as (\w+)", path.read_text(encoding="utf-8"))
            names = [f"{package}.{name}" for name in sorted(public)]
        parts += [f"## {title}", *(f"::: afm_rl.{name}" for name in names)]
    return "\n\n".join(parts) + "\n"


def on_files(files, config):
    """Add the pages that are made, or kept outside of docs/."""
    files.append(File.generated(config, "api.md", content=api_page()))
    for path, uri in COPIES.items():
        text = with_site_links((ROOT / path).read_text(encoding="utf-8"))
        files.append(File.generated(config, uri, content=text))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, made = MarkdownExporter().from_filename(str(path), {"unique_key": path.stem})
        text = text.replace("](../docs/", "](../")
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, image in made["outputs"].items():
            files.append(File.generated(config, f"notebooks/{name}", content=image))
    files.append(File.generated(config, "images/layers.svg", content=layers.draw()))
    for script in browser.BUILT.glob("*.js"):  # where there are none, the page says so
        uri = f"theme/try/{script.name}"
        files.append(File.generated(config, uri, abs_src_path=str(script)))
    return files


def on_page_markdown(markdown, page, **kwargs):
    """Point links that leave docs/ to the copies."""
    for path, uri in COPIES.items():
        markdown = markdown.replace(f"](../{path}", f"]({uri}")
    return markdown


def on_page_content(content, page, **kwargs):
    """Render formulas, so that a browser needs no script and no network for them."""

    def render(found):
        kind, formula = found[1], html.unescape(found[2])
        known = formula.replace(r"\arg\min", r"\operatorname{argmin}")  # the converter lacks it
        result = convert(known, display="block" if kind == "div" else "inline")
        if re.search(r"<m[ion]>(&|\\\w+)<", result):
            raise PluginError(f"{page.file.src_uri}: a formula that is not understood: {formula}")
        return result

    return FORMULA.sub(render, content)

"""A page in headless Chromium: what the console said, what was asked of the network, what was drawn."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-extensions", "--disable-default-apps",
    "--hide-scrollbars", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip

# Put into a copy of the page by the test alone: it measures what was drawn and writes it into the page.
PROBE = """
<script>
function parts(c){const m=c.match(/[\\d.]+/g).map(Number);return m.length<4?[...m,1]:m}
function lum(c){const f=c.slice(0,3).map(v=>{v/=255;return v<=.03928?v/12.92:((v+.055)/1.055)**2.4});
  return .2126*f[0]+.7152*f[1]+.0722*f[2]}
function paper(e){for(;e;e=e.parentElement){
  const c=parts(getComputedStyle(e).backgroundColor);if(c[3]>.99)return c}
  return [255,255,255,1]}
function ratio(e){const s=getComputedStyle(e),svg=e.namespaceURI.includes('svg');
  const a=lum(parts(svg?s.fill:s.color)),b=lum(paper(svg?e.closest('figure'):e));
  return (Math.max(a,b)+.05)/(Math.min(a,b)+.05)}
window.addEventListener('load',()=>{
  const told=[...document.querySelectorAll('body *')].filter(
    e=>[...e.childNodes].some(n=>n.nodeType==3&&n.data.trim()));
  const seen=told.filter(e=>!['SCRIPT','STYLE','title'].includes(e.tagName));
  const worst=seen.map(e=>[ratio(e),e.tagName,e.textContent.slice(0,40)])
    .sort((a,b)=>a[0]-b[0]).slice(0,5);
  const figures=[...document.querySelectorAll('figure svg')].map(s=>{const r=s.getBoundingClientRect();
    return [r.width,r.height,s.querySelectorAll('path').length]});
  const small=[...document.querySelectorAll('figure svg text')].map(t=>t.getBoundingClientRect().height);
  const out={worst,figures,text:Math.min(...small),
    scroll:document.documentElement.scrollWidth,view:innerWidth,
    loaded:performance.getEntriesByType('resource').map(r=>r.name),
    dark:matchMedia('(prefers-color-scheme:dark)').matches,
    background:getComputedStyle(document.body).backgroundColor};
  const e=document.createElement('script');e.type='application/json';e.id='probe';
  e.textContent=JSON.stringify(out);
  document.body.append(e)});
</script>
"""


@dataclass(frozen=True)
class Visit:
    """What came of opening a page."""

    console: tuple[str, ...]
    requests: tuple[str, ...]
    probe: dict


def chromium() -> str:
    """Path of the browser; the test is skipped where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome", "chrome"):
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")


def visit(page: Path, folder: Path, *, width: int = 1100, dark: bool = False) -> Visit:
    """Open a copy of `page` with the probe in it; `folder` is for the browser's own files."""
    copy = folder / f"probe-{width}-{dark}.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", PROBE + "</body>"), encoding="utf-8")
    log = folder / f"net-{width}-{dark}.json"
    done = _run(copy, folder, width, dark, "--enable-logging=stderr", f"--log-net-log={log}", "--dump-dom",
                "--virtual-time-budget=3000")  # fmt: skip
    console = tuple(line for line in done.stderr.splitlines() if "CONSOLE" in line)
    found = re.search(r'<script type="application/json" id="probe">(.*?)</script>', done.stdout, re.S)
    assert found, done.stderr[-2000:]
    return Visit(console, _requests(log), json.loads(found[1]))


def screenshot(
    page: Path, target: Path, folder: Path, *, width: int = 1100, height: int = 3000, dark: bool = False
):
    """Keep a picture of the page as a person sees it."""
    _run(page, folder, width, dark, f"--screenshot={target}", height=height)


def printed(page: Path, folder: Path) -> list[tuple[float, float]]:
    """Return the sizes (width, height) of the pages that the browser prints, mm."""
    target = folder / "page.pdf"
    _run(page, folder, 1100, False, f"--print-to-pdf={target}")
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", target.read_bytes())
    return [(float(w) * 25.4 / 72, float(h) * 25.4 / 72) for w, h in boxes]


def _run(page: Path, folder: Path, width: int, dark: bool, *more: str, height: int = 900):
    scheme = ["--blink-settings=preferredColorScheme=0"] if dark else []
    own = [f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}"]
    command = [chromium(), *QUIET, *scheme, *own, *more, page.resolve().as_uri()]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


def _requests(log: Path) -> tuple[str, ...]:
    """Addresses that the page asked for; the browser's own calls, which have no origin, are left out."""
    text = log.read_text(encoding="utf-8")
    try:
        events = json.loads(text)["events"]
    except json.JSONDecodeError:  # the browser ended before it closed the list
        events = json.loads(text.rstrip().rstrip(",") + "]}")["events"]
    asked = [e["params"] for e in events if {"url", "initiator"} <= set(e.get("params", {}))]
    urls = {p["url"] for p in asked if p["initiator"] != "not an origin"}
    return tuple(sorted(u for u in urls if not u.startswith(("data:", "chrome:", "devtools:", "about:"))))

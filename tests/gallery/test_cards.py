"""Cards of the gallery, and the page that shows them beside the papers' figures."""

from html.parser import HTMLParser

from dirax import gallery
from dirax.gallery import cards, exhibition
from dirax.gallery.reproduction import AGREES, Reproduction, Row


def test_every_system_says_what_to_look_at():
    assert set(cards.LOOK) == set(gallery.names())


def test_the_page_shows_figures_tables_and_every_card(tmp_path, monkeypatch):
    monkeypatch.setattr(gallery, "names", lambda: ("pendulum", "double-spherical-pendulum"))
    result = Reproduction("PY", "A <paper>", (Row("θ(50)", "1", "1", AGREES, "a note"),), {"figure_09": None})
    told = []
    path = exhibition.write_index([result], tmp_path, lambda fraction, text: told.append(fraction))
    text = path.read_text("utf-8")
    assert 'src="PY/figure_09.png"' in text and "A &lt;paper&gt;" in text and "θ(50)" in text and "[1] a note" in text
    assert 'id="pendulum"' in text and "<math" in text and 'class="written"' in text
    sources = []

    class Pictures(HTMLParser):
        def handle_starttag(self, tag, attrs):
            sources.append(dict(attrs).get("src" if tag == "img" else "href"))

    Pictures().feed(text)
    there = [tmp_path / name for name in sources if name and not name.startswith(("#", "PY/"))]
    assert len(there) == 3 and all(file.stat().st_size > 10_000 for file in there)
    assert told == sorted(told) and told[-1] <= 1.0

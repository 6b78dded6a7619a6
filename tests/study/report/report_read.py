"""A report's page as a parser of html gives it."""

import json
from html.parser import HTMLParser

from ppo_dap.cli import main
from ppo_dap.study.report.page import write_report
from study.report.report_made import make_run

HOSTILE = "<script>alert(1)</script>&\"'"


SWIM = {"task": "Swimmer-v5", "gamma": 0.9999}


VOID = ("meta", "img", "br", "link", "input")


class Page(HTMLParser):
    """Tables, text by element, tags and attributes, as a parser of html gives them."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.tables, self.texts = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag == "table":
            self.tables.append({"caption": "", "rows": []})
        if tag == "tr":
            self.tables[-1]["rows"].append([])
        if tag in ("td", "th"):
            self.tables[-1]["rows"][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))
        if "td" in self.open or "th" in self.open:
            self.tables[-1]["rows"][-1][-1] += data
        elif self.open[-1:] == ["caption"]:
            self.tables[-1]["caption"] += data

    def table(self, *heads):
        """Rows, by head, of the tables that have these heads."""
        found = [t["rows"] for t in self.tables if set(heads) <= set(t["rows"][0])]
        return [dict(zip(rows[0], row, strict=True)) for rows in found for row in rows[1:]]

    def data(self):
        (text,) = (data for tag, data in self.texts if tag == "script" and data.startswith("{"))
        return json.loads(text)

    def words(self):
        return " ".join("".join(data for tag, data in self.texts if tag not in ("script", "style")).split())


def summary(capsys, *arguments):
    assert main(["summary", *arguments, "--epochs", "10"]) == 0
    return capsys.readouterr().out


def written(folders, path, **options):
    write_report([str(folder) for folder in folders], path, **{"epochs": 10.0, **options})
    return Page(path.read_text())


def made(tmp_path, heights, seeds=range(7), **changes):
    """A method (a learning rate of its own) for each height."""
    found = []
    for place, height in enumerate(heights):
        rate = 1e-3 * (place + 1)
        found += [
            make_run(tmp_path / f"{place}-{seed}", seed=seed, height=height, learning_rate=rate, **changes)
            for seed in seeds
        ]
    return found

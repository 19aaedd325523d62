"""Join the results of one magnet into one page: the answer of every command, with links.

Reads folders that other commands have written, and says what does not fit together: results of an
earlier version of the study, of another map, or changed since. Nothing is computed. The page needs
no network; its links need the folders where they are.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("folders", type=common.path, nargs="+", metavar="DIR",
                        help="folder of results, of solve, infer, diagnose and so on")
    parser.add_argument("-o", "--output", type=common.path, required=True, metavar="PAGE",
                        help="page to write (.html), or a folder for report.html")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read the folders, write the page, print the answers."""
    from halbach_fe.report.campaign_report import read_campaign, write_campaign_report

    campaign = read_campaign(arguments.folders, arguments.output)
    page = write_campaign_report(campaign, arguments.output)
    if arguments.json:
        common.print_json(campaign.plain())
        return 0
    common.print_table([{"results": chapter.label, "command": chapter.verb, "answer": answer.said}
                        for chapter, _, answer in campaign.answered], campaign.study.name)
    for sentence in (*campaign.versions, *campaign.doubts):
        common.say(sentence)
    common.say_answer(argparse.Namespace(), campaign.answer, page)
    return 0

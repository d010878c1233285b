"""The generated safety documents.

``python tests/safety/documents.py --write`` writes them into docs/, and the bill of materials beside the lock file;
``test_documents.py`` fails while one is out of date.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from risks import DOCS, hazards_page, requirements_page, traceability_page
from software import BILL, bill_of_materials, software_page, third_party_page, told_licences

PAGES = {
    "requirements.md": requirements_page,
    "hazards.md": hazards_page,
    "traceability.md": traceability_page,
    "third_party.md": third_party_page,
    "software.md": software_page,
}


def write(docs: Path, bill: Path) -> None:
    """Write the pages, and the bill of materials with the licences that they say."""
    for name, page in PAGES.items():
        (docs / name).write_text(page(), encoding="utf-8")
    bill.write_text(bill_of_materials(told_licences()), encoding="utf-8")


def main() -> None:
    """Write them into docs/."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", required=True, help="write them into docs/")
    parser.parse_args()
    write(DOCS, BILL)


if __name__ == "__main__":
    main()

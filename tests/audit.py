"""Look for known vulnerabilities of the pinned versions, once a day; run by `make lint`.

Without a network, or without pip-audit, it only says that nothing was checked.
"""

import datetime
import json
import subprocess
import sys
from pathlib import Path

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
SECONDS = 60


def main() -> None:
    mark = Path(sys.prefix) / ".audited"
    today = f"{datetime.date.today()} {CONSTRAINTS.stat().st_mtime_ns}"
    if mark.is_file() and mark.read_text() == today:
        return
    command = [sys.executable, "-m", "pip_audit", "-r", str(CONSTRAINTS), "--no-deps"]
    command += ["--disable-pip", "--timeout", "5", "--progress-spinner", "off", "-f", "json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
        found = json.loads(done.stdout)["dependencies"]
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError):
        print("Warning: known vulnerabilities were not checked (no network, or no pip-audit)")
        return
    checked = [one for one in found if "vulns" in one and not one.get("skip_reason")]
    lines = [
        f"{one['name']} {one['version']}: {flaw['id']}, mended in {flaw['fix_versions'] or 'none'}"
        for one in checked
        for flaw in one["vulns"]
    ]
    if lines:
        sys.exit("\n".join(lines))
    warning = "" if len(checked) == len(found) else "Warning: the others are not in the database; "
    print(f"{warning}pip-audit: {len(checked)} of {len(found)} pinned versions checked, no flaws")
    mark.write_text(today)


if __name__ == "__main__":
    main()

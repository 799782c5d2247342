"""Unpacks chosen members of wheels.

Arguments: the folder with the wheels, the folder to write to, then rules `member=>destination`. A rule whose member ends in `/`
takes the whole folder. Exits with an error that names the rule when one finds nothing.
"""

import pathlib
import shutil
import sys
import zipfile


def main() -> None:
    wheels, destination = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
    unmatched = dict(rule.split("=>") for rule in sys.argv[3:])
    rules = dict(unmatched)
    for wheel in sorted(wheels.glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            for member in archive.infolist():
                for source, target in rules.items():
                    if member.is_dir() or not (member.filename == source or (source.endswith("/") and member.filename.startswith(source))):
                        continue
                    path = destination / (target + member.filename[len(source) :])
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with archive.open(member) as reader, path.open("wb") as writer:
                        shutil.copyfileobj(reader, writer, 1 << 20)
                    unmatched.pop(source, None)
    if unmatched:
        sys.exit(f"no member of the wheels in {wheels} matches {sorted(unmatched)}")


if __name__ == "__main__":
    main()

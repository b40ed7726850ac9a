"""`coil-info`: print the versions that a bug report needs."""

from __future__ import annotations

from coil_rl.train.run_folder import versions


def main() -> None:
    """Print a version a line."""
    found = versions()
    width = max(map(len, found))
    for name, version in found.items():
        print(f"{name:{width}}  {version}")


if __name__ == "__main__":
    main()

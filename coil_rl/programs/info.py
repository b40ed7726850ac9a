"""`coil-info`: what to paste into a bug report."""

from __future__ import annotations

from coil_rl.train.versions import versions


def main() -> None:
    """Print the versions of everything that matters, one a line."""
    found = versions()
    width = max(map(len, found))
    for name, version in found.items():
        print(f"{name:{width}}  {version}")


if __name__ == "__main__":
    main()

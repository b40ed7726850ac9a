"""`coil-info`: print the versions that a bug report needs."""

from coil_rl.run.folder import versions


def main() -> None:
    """Print a version a line."""
    result = versions()
    width = max(map(len, result))
    for name, version in result.items():
        print(f"{name:{width}}  {version}")


if __name__ == "__main__":
    main()

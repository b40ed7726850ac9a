"""From YAML to a run: schema, composition, checks, trust.

Besides the programs it is the only package that reads YAML.
"""

import logging

import coil_rl.config.schema  # noqa: F401  registers with Hydra

logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)  # it logs the errors that it raises

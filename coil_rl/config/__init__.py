"""From YAML to a run: schema, composition, checks, trust; the only package besides the programs that reads it."""

import coil_rl.config.schema  # noqa: F401  registers the root configurations and resolvers with Hydra

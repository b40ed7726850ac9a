"""Shipped policies: small finished runs, each with a card; `coil_rl.pretrained` opens them."""

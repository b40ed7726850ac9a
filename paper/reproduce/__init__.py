"""Reproduced tables and figures of the paper, each with the paper's values next to ours."""

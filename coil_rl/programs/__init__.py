"""The console programs. Modules here import torch and all that depends on it only inside their functions."""

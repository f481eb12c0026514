"""Examples of training on third-party environments."""

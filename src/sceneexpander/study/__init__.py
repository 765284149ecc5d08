"""The human study: people rank the videos of methods that they are not told, by two criteria."""

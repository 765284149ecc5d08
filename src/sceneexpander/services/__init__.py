"""Services on the network that cost something: how they are asked, and what becomes of what they say."""

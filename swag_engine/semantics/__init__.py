"""Names for things: regions of photographs, their embeddings, and what they make of each Gaussian."""

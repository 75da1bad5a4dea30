"""Labels of Gaussians: regions, embeddings, text search."""

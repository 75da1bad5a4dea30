"""Labels of Gaussians: regions of images, embeddings, and text search."""

"""Statistics of misspecification, of what a model leaves unexplained; they compute and do not judge."""

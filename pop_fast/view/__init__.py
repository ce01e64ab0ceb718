"""What is shown of captures, splats and results: the report, the explainer, camera paths, pictures."""

"""Build your own Gaussian splatting, stage by stage, judged by the conformance kit."""

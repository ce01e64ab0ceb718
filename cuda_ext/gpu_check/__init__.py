"""Everything that only a GPU can tell, in four jobs: `python3 -m cuda_ext.gpu_check`."""

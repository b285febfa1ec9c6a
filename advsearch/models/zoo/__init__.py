"""Networks by the name that a library gives them: ``torchvision:resnet50``, ``timm:resnet50``, ``hf:OWNER/REPOSITORY``.

Each library is imported when one of its networks is asked for, and not before. It brings the weights, as it does for
anybody: from its cache on this machine, else from where it publishes them. They are read without unpickling.
"""

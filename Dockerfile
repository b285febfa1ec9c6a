# advsearch with libLLVM inside:
#   docker build -t advsearch .
#   docker run --rm -v "$PWD/runs:/home/advsearch/runs" advsearch attack --object mug --control texture
# pip takes torch's CUDA build here, gigabytes that are of no use. PyTorch's "Get started" page names an index of CPU
# wheels: docker build --build-arg TORCH_INDEX=ITS-ADDRESS -t advsearch .
FROM python:3.12-slim-bookworm

ARG TORCH_INDEX=

# Debian keeps no older versions of a package, so that a pinned one would soon be gone.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libllvm19 \
    && rm -rf /var/lib/apt/lists/*

COPY . /advsearch
RUN pip install --no-cache-dir ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} \
    -c /advsearch/constraints.txt '/advsearch[dask,explain,parquet]' \
    && advsearch doctor

RUN useradd --create-home --uid 1000 advsearch
USER 1000
WORKDIR /home/advsearch
ENTRYPOINT ["advsearch"]
CMD ["--help"]

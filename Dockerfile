# docker build -t calgraph . ; docker run --rm -v "$PWD:/data" calgraph calibrate rig.yaml recording -o result
FROM python:3.11-slim
COPY requirements/runtime.txt /tmp/
RUN pip install --no-cache-dir --require-hashes -r /tmp/runtime.txt
COPY pyproject.toml README.md LICENSE /calgraph/
COPY src /calgraph/src
# The pages of calgraph docs.
COPY docs /calgraph/docs
RUN pip install --no-cache-dir --no-deps /calgraph
# Detections are kept between runs only where a volume is mounted on it.
ENV CALGRAPH_CACHE=/cache
WORKDIR /data
ENTRYPOINT ["calgraph"]

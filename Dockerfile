# An image for clusters. Its kernels are compiled for the processor it is built on; on another kind
# of processor they compile once more, at the first start.
#   docker build -t shapecat .
#   docker run --rm -v "$PWD":/data shapecat process /data/lab.mcap --out /data/out
FROM python:3.12-slim
WORKDIR /opt/shapecat
COPY requirements.lock ./
RUN pip install --no-cache-dir --no-deps --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY shapecat shapecat
COPY cli cli
COPY schemas schemas
RUN pip install --no-cache-dir --no-deps . && python -m shapecat.rehearsal
ENTRYPOINT ["shapecat"]

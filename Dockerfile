# docker build -t sb3-saf . && docker run --rm -v "$PWD/runs:/sb3-saf/runs" sb3-saf
FROM python:3.12-slim
WORKDIR /sb3-saf
COPY . .
RUN pip install --no-cache-dir --constraint constraints.txt --editable ".[export,render,zoo]"
CMD ["python", "-m", "sb3_saf.quickstart"]

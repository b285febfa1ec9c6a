#!/usr/bin/env bash
# Builds the pages of every git tag, and of this commit as `latest`, into build/versions/NAME, with a list of them.
# Usage: tools/docs_versions.sh, from the root of the checkout, with mkdocs on the path.
set -euo pipefail

out=$PWD/build/versions
work=$(mktemp -d)
trap 'rm -rf "$work"; git worktree prune' EXIT
mkdir -p "$out"

for version in $(git tag --sort=-version:refname) latest; do
  commit=$version
  [ "$version" != latest ] || commit=HEAD
  [ "$version" = latest ] || [ ! -e "$out/$version/index.html" ] || continue # a tag does not move
  git worktree add --quiet --detach "$work/$version" "$commit"
  (cd "$work/$version" && NO_MKDOCS_2_WARNING=1 PYTHONPATH=. mkdocs build --quiet --site-dir "$out/$version")
done

{
  echo '<!doctype html><meta charset="utf-8"><title>advsearch</title><h1>advsearch</h1><ul>'
  for folder in "$out"/*/; do
    name=$(basename "$folder")
    echo "<li><a href=\"$name/index.html\">$name</a></li>"
  done
  echo '</ul>'
} > "$out/index.html"
ls "$out"

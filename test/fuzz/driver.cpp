// SPDX-License-Identifier: Apache-2.0
/// @file `TARGET ITERATIONS FOLDER…`: gives every file of the folders to the target, then
/// ITERATIONS mutations of them. The same inputs in every run; the last one is told when it fails.
#include <csignal>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

#include "fuzz.h"

namespace {

std::string last_input;

void tellLastInput(int) {
  std::fprintf(stderr, "failed on %zu bytes:\n", last_input.size());
  std::fwrite(last_input.data(), 1, last_input.size(), stderr);
  std::_Exit(1);
}

std::string mutate(const std::vector<std::string>& seeds, std::mt19937& random) {
  const auto below = [&](std::size_t n) { return random() % (n == 0 ? 1 : n); };
  static const char* const kWords[] = {"-1", "0",     "1e309", "nan",  ".inf", "99999999999",
                                       "{",  "[",     "[[[",   "\n  ", ": ",   ",",
                                       "\"", "&a *a", "- ",    "~"};
  std::string text = seeds[below(seeds.size())];
  for (std::size_t change = 1 + below(6); change > 0; --change) {
    const std::size_t at = below(text.size() + 1);
    const std::size_t length = below(std::min<std::size_t>(text.size() - at, 40) + 1);
    switch (below(6)) {
      case 0:
        if (at < text.size()) text[at] = static_cast<char>(random());
        break;
      case 1:
        text.erase(at, length);
        break;
      case 2:
        text.insert(at, text.substr(below(text.size() + 1), length));
        break;
      case 3:
        text.replace(at, length, kWords[below(std::size(kWords))]);
        break;
      case 4: {
        const std::string& other = seeds[below(seeds.size())];
        text.replace(at, std::string::npos, other, below(other.size() + 1));
        break;
      }
      default:
        if (at < text.size()) text[at] ^= static_cast<char>(1u << below(8));
    }
  }
  return text;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: %s ITERATIONS FOLDER…\n", argv[0]);
    return 2;
  }
  std::vector<std::string> seeds;
  for (int i = 2; i < argc; ++i)
    for (const auto& entry : std::filesystem::directory_iterator(argv[i])) {
      std::ifstream file(entry.path(), std::ios::binary);
      seeds.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
    }
  if (seeds.empty()) {
    std::fprintf(stderr, "no seeds in the folders\n");
    return 1;
  }
  for (const int signal : {SIGABRT, SIGSEGV, SIGBUS, SIGFPE, SIGILL})
    std::signal(signal, tellLastInput);
  for (const std::string& seed : seeds) omnister::fuzz::fuzzOne(last_input = seed);
  std::mt19937 random(20);
  const long iterations = std::atol(argv[1]);
  for (long i = 0; i < iterations; ++i) omnister::fuzz::fuzzOne(last_input = mutate(seeds, random));
  std::printf("%zu seeds, %ld mutations\n", seeds.size(), iterations);
  return 0;
}

// Run an exported policy (afm-rl-export) without Python.
//
//   cmake -S . -B build -DCMAKE_PREFIX_PATH="$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')"
//   cmake --build build
//   build/run_policy policy.pt2 [SEED] < states.txt
//
// Each line of the input is one tick: the state, then the task's numbers, such as the goal. Each line
// of the output is the action to execute; the first line says what the policy reads.
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

#include <cmath>
#include <iostream>
#include <sstream>
#include <vector>

int main(int argc, char** argv) {
  if (argc < 2) {
    std::cerr << "run_policy POLICY.pt2 [SEED] < STATES\n";
    return 2;
  }
  torch::NoGradGuard no_grad;
  torch::set_num_threads(1);
  torch::manual_seed(argc > 2 ? std::stoull(argv[2]) : 0);
  torch::inductor::AOTIModelPackageLoader policy(argv[1]);
  auto about = policy.get_metadata();
  const auto kind = about.at("dtype") == "float64" ? torch::kFloat64 : torch::kFloat32;
  const double bound = std::stod(about.at("noise_bound"));
  std::cerr << "arguments: " << about.at("arguments") << "\n";

  std::vector<std::string> names;
  std::vector<torch::Tensor> given;  // memory, observation, the task's entries, noise
  std::istringstream arguments(about.at("arguments"));
  for (std::string word; arguments >> word;) {
    const auto colon = word.rfind(':');
    names.push_back(word.substr(0, colon));
    given.push_back(torch::zeros({std::stol(word.substr(colon + 1))}, kind));
  }

  std::cout.precision(9);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream numbers(line);
    for (size_t k = 1; k < given.size(); ++k) {
      if (names[k] == "noise") {
        // Standard normal numbers, none beyond the bound.
        if (std::isfinite(bound)) {
          const double edge = std::erf(bound / std::sqrt(2.0));
          given[k] = torch::empty_like(given[k]).uniform_(-edge, edge).erfinv_() * std::sqrt(2.0);
        } else {
          given[k] = torch::randn_like(given[k]);
        }
        continue;
      }
      for (int64_t i = 0; i < given[k].numel(); ++i) {
        double number = NAN;  // of a line that is too short: the policy ignores such a reading
        numbers >> number;
        given[k][i] = number;
      }
    }
    auto found = policy.run(given);
    given[0] = found[0];
    auto action = found[1].to(torch::kFloat64);
    for (int64_t i = 0; i < action.numel(); ++i) {
      std::cout << (i ? " " : "") << action[i].item<double>();
    }
    std::cout << std::endl;
  }
}

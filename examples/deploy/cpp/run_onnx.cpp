// Run an exported graph (afm-rl-export out=policy.onnx) without Python and without torch.
//
//   c++ -O2 -std=c++17 run_onnx.cpp -o run_onnx -ldl
//   echo "CHECKSUM  policy.onnx" | sha256sum -c && ./run_onnx libonnxruntime.so policy.onnx [SEED] < states.txt
//
// The library is that of the Python package, onnxruntime/capi/libonnxruntime.so.*, or of any release
// since 1.16. Each line of the input is one tick: the state, then the task's numbers, such as the goal
// or the planned action. Each line of the output is the action to execute. What the file reads, and how
// long ticks took, goes to standard error.
#include <dlfcn.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <random>
#include <sstream>
#include <string>
#include <vector>

// What is used of onnxruntime's C interface: a table of functions that only ever grows at its end
// (onnxruntime_c_api.h, MIT), here by their place in it. They return null, or a status.
struct ApiBase {
  void* const* (*api)(uint32_t version);
  const char* (*version)();
};
enum Place {
  kGetErrorMessage = 2,
  kCreateEnv = 3,
  kCreateSession = 7,
  kRun = 9,
  kCreateSessionOptions = 10,
  kSetIntraOpNumThreads = 24,
  kCreateTensorWithData = 49,
  kGetTensorMutableData = 51,
  kCreateCpuMemoryInfo = 69,
  kGetAllocator = 78,
  kReleaseValue = 96,
  kGetModelMetadata = 111,
  kLookupMetadata = 116,
};
constexpr uint32_t kVersion = 16;
void* const* api;

template <class... T>
void call(Place place, T... given) {
  if (void* status = reinterpret_cast<void* (*)(T...)>(api[place])(given...)) {
    std::cerr << reinterpret_cast<const char* (*)(void*)>(api[kGetErrorMessage])(status) << "\n";
    std::exit(2);
  }
}

std::string look_up(void* about, void* allocator, const char* key) {
  char* text = nullptr;
  call(kLookupMetadata, about, allocator, key, &text);
  return text ? text : "";
}

// Answer each line with an action; numbers are of onnxruntime's type `kind`.
template <class Number>
void drive(void* session, int kind, std::istringstream arguments, double bound, size_t actions, uint64_t seed) {
  std::vector<std::string> names;
  std::vector<std::vector<Number>> given;  // memory, observation, the task's entries, noise
  for (std::string word; arguments >> word;) {
    const auto colon = word.rfind(':');
    names.push_back(word.substr(0, colon));
    given.emplace_back(std::stoul(word.substr(colon + 1)), Number(0));
  }
  std::vector<const char*> inputs;
  std::vector<void*> tensors(given.size());
  void* cpu;
  call(kCreateCpuMemoryInfo, 0, 0, &cpu);
  for (size_t k = 0; k < given.size(); ++k) {
    const int64_t size = given[k].size();
    inputs.push_back(names[k].c_str());
    call(kCreateTensorWithData, cpu, static_cast<void*>(given[k].data()), sizeof(Number) * given[k].size(), &size,
         size_t{1}, kind, &tensors[k]);
  }
  const char* outputs[] = {"next_memory", "executed_action"};
  std::mt19937_64 random(seed);
  std::normal_distribution<double> normal;
  std::vector<double> took;
  std::cout.precision(9);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream numbers(line);
    for (size_t k = 1; k < given.size(); ++k) {
      for (Number& number : given[k]) {
        if (names[k] == "noise") {
          do number = normal(random);
          while (std::abs(number) > bound);
        } else if (!(numbers >> number)) {
          number = NAN;  // of a line that is too short: the policy ignores such a reading
        }
      }
    }
    void* found[2] = {nullptr, nullptr};
    const auto begun = std::chrono::steady_clock::now();
    call(kRun, session, static_cast<void*>(nullptr), inputs.data(), tensors.data(), tensors.size(),
         static_cast<const char**>(outputs), size_t{2}, static_cast<void**>(found));
    const std::chrono::duration<double, std::milli> spent = std::chrono::steady_clock::now() - begun;
    took.push_back(spent.count());
    Number *memory, *action;
    call(kGetTensorMutableData, found[0], reinterpret_cast<void**>(&memory));
    call(kGetTensorMutableData, found[1], reinterpret_cast<void**>(&action));
    std::copy(memory, memory + given[0].size(), given[0].begin());
    for (size_t i = 0; i < actions; ++i) std::cout << (i ? " " : "") << action[i];
    std::cout << std::endl;
    for (void* value : found) reinterpret_cast<void (*)(void*)>(api[kReleaseValue])(value);
  }
  if (took.empty()) return;
  std::nth_element(took.begin(), took.begin() + took.size() / 2, took.end());
  std::cerr << took.size() << " ticks, median " << took[took.size() / 2] << " ms\n";
}

int main(int argc, char** argv) {
  void* library = argc < 3 ? nullptr : dlopen(argv[1], RTLD_NOW);
  void* entry = library ? dlsym(library, "OrtGetApiBase") : nullptr;
  if (!entry) {
    std::cerr << "run_onnx LIBONNXRUNTIME.so POLICY.onnx [SEED] < STATES\n";
    return 2;
  }
  const auto* base = reinterpret_cast<const ApiBase* (*)()>(entry)();
  api = base->api(kVersion);
  void *env, *options, *session, *allocator, *about;
  call(kCreateEnv, 3, "run_onnx", &env);  // 3: errors alone
  call(kCreateSessionOptions, &options);
  call(kSetIntraOpNumThreads, options, 1);  // the work is many small steps
  call(kCreateSession, env, static_cast<const char*>(argv[2]), options, &session);
  call(kGetAllocator, &allocator);
  call(kGetModelMetadata, session, &about);
  const auto arguments = look_up(about, allocator, "arguments"), dtype = look_up(about, allocator, "dtype");
  if (arguments.empty()) {
    std::cerr << argv[2] << ": expected a graph of afm-rl-export\n";
    return 2;
  }
  std::cerr << "onnxruntime " << base->version() << ", arguments: " << arguments << "\n";
  const double bound = std::stod(look_up(about, allocator, "noise_bound"));
  const size_t actions = std::stoul(look_up(about, allocator, "actions"));
  const uint64_t seed = argc > 3 ? std::stoull(argv[3]) : 0;
  if (dtype == "float64") {
    drive<double>(session, 11, std::istringstream(arguments), bound, actions, seed);  // 11: double
  } else {
    drive<float>(session, 1, std::istringstream(arguments), bound, actions, seed);  // 1: float
  }
}
